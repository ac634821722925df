"""Amplitude of the light that passes the pipe three times, since both facets reflect."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.goodness.equations import equations_of_fit
from lightpage.calibration.goodness.light import PageLight, coarse_page

_RANK = 1e-4
"""Singular values are dropped below this share of the largest."""
_PASSES = 3


class GhostAmplitude(NamedTuple):
    """Amplitude of the light that passes three times over that of the light that passes once.

    Attributes:
        relative: value.
        deviation: its standard deviation.
    """

    relative: float
    deviation: float

    def __str__(self) -> str:
        """Amplitude in words."""
        return f" ({self.relative:.4f} +- {self.deviation:.4f} of the amplitude of the light that passes once)"


def changes_by_ghost(light: PageLight) -> list[NDArray[np.complexfloating]]:
    """Changes of both cameras' light on the coarse grid by light that passes three times, in phase and a quarter on."""
    length = light.waves.channel.geometry.pipe_length_m
    passed = light.changed(pipe_length_m=_PASSES * length).to_cameras(coarse_page(light))
    return [passed, 1j * passed]


def ghost_amplitude(light: PageLight) -> GhostAmplitude:
    """Fit the amplitude of the light that passes three times to a known page, beside the parameters of the device."""
    columns = [*map(light.equations_of, changes_by_ghost(light)), *equations_of_fit(light)]
    matrix = np.stack(columns, axis=1)
    lengths = np.maximum(np.linalg.norm(matrix, axis=0), np.finfo(float).tiny)
    residual = light.equation_residual
    inverse = scipy.linalg.pinv(matrix / lengths, rtol=_RANK)
    solution = inverse @ residual
    remaining = residual - matrix / lengths @ solution
    # what is unexplained differs from symbol to symbol, so equations tell no more than symbols do
    variance = remaining @ remaining / min(len(residual), 2 * light.symbols.size)
    in_phase, quadrature = solution[:2] / lengths[:2]
    deviations = np.sqrt(variance * np.sum(inverse[:2] ** 2, axis=1)) / lengths[:2]
    return GhostAmplitude(float(np.hypot(in_phase, quadrature)), float(np.max(deviations)))
