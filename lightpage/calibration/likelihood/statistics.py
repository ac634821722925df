"""Statistics of a device's light and counts, as the calibration document keeps them."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from lightpage.calibration.likelihood.counts import CountStatistics, Values, check_points
from lightpage.calibration.waves.wave_model import ILLUMINATIONS, LaunchConditions
from lightpage.device.profile import Finite, TomlTable

Coefficients = Annotated[tuple[Finite, ...], Field(min_length=ILLUMINATIONS, max_length=ILLUMINATIONS, strict=False)]


class Statistics(TomlTable):
    """Statistics of a device's light and counts.

    Attributes:
        blur: variance of the modulator's blur, over the square of its pixels' pitch.
        illumination_real, illumination_imaginary: coefficients of the illumination's terms, see
            `lightpage.calibration.waves.wave_model.illumination_terms`.
        correlation: variance of the score of the known pages, over the Fisher information of independent samples. It
            exceeds 1 because neighbours on the grid are correlated, and because of unexplained light.
        in_phase_expected, in_phase_mean, in_phase_variance: statistics of the in-phase camera, see `CountStatistics`.
        quadrature_expected, quadrature_mean, quadrature_variance: the same of the quadrature camera.
    """

    blur: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    illumination_real: Coefficients
    illumination_imaginary: Coefficients
    correlation: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    in_phase_expected: Values
    in_phase_mean: Values
    in_phase_variance: Values
    quadrature_expected: Values
    quadrature_mean: Values
    quadrature_variance: Values

    @model_validator(mode="after")
    def _checked(self) -> Self:
        check_points(self.in_phase_expected, self.in_phase_mean, self.in_phase_variance, "in_phase_")
        check_points(self.quadrature_expected, self.quadrature_mean, self.quadrature_variance, "quadrature_")
        return self

    @classmethod
    def of(
        cls, conditions: LaunchConditions, cameras: tuple[CountStatistics, CountStatistics], correlation: float
    ) -> Statistics:
        """Combine the conditions of launched light and the statistics of both cameras' counts."""
        names = zip(("in_phase", "quadrature"), cameras, strict=True)
        return cls(
            blur=float(conditions.blur),
            illumination_real=tuple(conditions.illumination.real.tolist()),
            illumination_imaginary=tuple(conditions.illumination.imag.tolist()),
            correlation=correlation,
            **{f"{name}_{key}": value for name, camera in names for key, value in camera.model_dump().items()},
        )

    @property
    def conditions(self) -> LaunchConditions:
        """Conditions under which the pages' light is launched."""
        return LaunchConditions(
            np.array(self.illumination_real) + 1j * np.array(self.illumination_imaginary), self.blur
        )

    @property
    def cameras(self) -> tuple[CountStatistics, CountStatistics]:
        """Statistics of the in-phase and of the quadrature camera's counts."""
        in_phase = CountStatistics(
            expected=self.in_phase_expected, mean=self.in_phase_mean, variance=self.in_phase_variance
        )
        quadrature = CountStatistics(
            expected=self.quadrature_expected, mean=self.quadrature_mean, variance=self.quadrature_variance
        )
        return in_phase, quadrature
