"""Noise of an estimator's phases after each step, and its flat field, measured on known pages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.likelihood.flat_field import flat_field
from lightpage.calibration.likelihood.noise import expected_bits, fitted_noise
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import FLAT_FIELD, pilot_tensors
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.device.profile import Profile
from lightpage.page.correction import wrapped
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.execution.estimator_graph import (
    DEVIATION_PRECISION,
    NO_DEVIATIONS,
    NOISE,
    EstimatorGraph,
)
from lightpage.waves.grid import symbol_samples

MOST_STEPS = 6
"""Largest number of Gauss-Newton steps."""
_LEAST_GAIN_BITS = 0.004
"""Least gain of information for another step, for a flat field, and for the estimation of deviations, bits a symbol."""


class KnownPhases(NamedTuple):
    """Frames of a known page, and the phases of its light.

    Attributes:
        pair: frames of the page.
        phases: phases of the symbols' light, radians [ny, nx].
    """

    pair: FramePair
    phases: NDArray[np.float64]

    @classmethod
    def of(cls, page: KnownPage, device: CalibratedDevice) -> KnownPhases:
        """Compute the phases of a page's light with the device's modulation."""
        return cls(page.pair, np.angle(page.light(device.modulation)))

    def feeds(self, mask: NDArray[np.bool_]) -> dict[str, NDArray[np.generic]]:
        """Return the tensors that a graph is fed with for this page: its frames, and its own pilots at `mask`."""
        frames = {"in_phase": self.pair.in_phase, "quadrature": self.pair.quadrature}
        return {**frames, **pilot_tensors(Pilots(mask, self.phases[mask]))}


def deviation_prior_scale(profile: Profile, statistics: Statistics) -> float:
    """Prior variance of a sample's deviation, over the variance of an estimated phase of a symbol.

    A symbol has so many samples; and the likelihood divides the information of the counts by the statistics'
    correlation.
    """
    return symbol_samples(profile) ** 2 * statistics.correlation


def measured_noise(
    graph: EstimatorGraph,
    pages: Sequence[KnownPhases],
    mask: NDArray[np.bool_],
    prior_scale: float,
    steps: int | None = None,
) -> SamplingTable:
    """Measure the noise of the first estimate and after each step, the flat field, and the prior of the deviations.

    Deviations of the modulator's samples are estimated only if known pages are read better with them. There is a flat
    field only if each known page is read better, on average, with that of the others.

    Args:
        graph: graph of the device without a flat field, with at least `steps` steps, or `MOST_STEPS` if these are left out.
        pages: known pages.
        mask: positions of the pilots, bool [ny, nx].
        prior_scale: see `deviation_prior_scale`.
        steps: number of steps; if left out, as many as gain information.

    Returns:
        `NOISE` [steps + 1, 2], `FLAT_FIELD` [ny, nx] and `DEVIATION_PRECISION` [].
    """
    information = graph.value("information")[~mask].astype(np.float64)
    fixed = _measured(graph.with_table({DEVIATION_PRECISION: NO_DEVIATIONS}), pages, mask, steps)
    variance = float(np.mean(fixed.noise[-1, 0] / information + fixed.noise[-1, 1]))
    precision = np.array(1 / (prior_scale * variance), np.float32)
    fitted = _measured(graph.with_table({DEVIATION_PRECISION: precision}), pages, mask, steps)
    if fitted.bits < fixed.bits + _LEAST_GAIN_BITS:
        fitted = fixed
        precision = NO_DEVIATIONS
    return {NOISE: fitted.noise, FLAT_FIELD: fitted.flat_field.astype(np.float32), DEVIATION_PRECISION: precision}


class _Measured(NamedTuple):
    """Measurements on known pages.

    Attributes:
        noise: noise after each step, [steps + 1, 2].
        flat_field: mean error of the symbols' phases after the last step, radians [ny, nx].
        bits: expected information after the last step, bits a symbol.
    """

    noise: NDArray[np.float32]
    flat_field: NDArray[np.float64]
    bits: float


def _measured(
    graph: EstimatorGraph, pages: Sequence[KnownPhases], mask: NDArray[np.bool_], steps: int | None
) -> _Measured:
    """Measure noise and flat field.

    An error is reduced by the flat field of the other pages. That is what a graph with this flat field would give, to
    first order, and needs no further runs.
    """
    most = MOST_STEPS if steps is None else steps
    noise = np.tile(np.array([1, 0], np.float32), (len(graph.value(NOISE)), 1))
    information = graph.value("information")[~mask].astype(np.float64)
    everywhere = np.tile(information, len(pages))
    flat = np.zeros(mask.shape)
    bits = 0.0
    for number in range(most + 1):
        graph = graph.with_table({NOISE: noise})
        errors = np.stack([_errors(graph, page, mask, number) for page in pages])
        repeated = flat_field(errors)
        row = fitted_noise(errors[:, ~mask].ravel(), everywhere)
        reached = expected_bits(row, information)
        corrected_row = fitted_noise((errors - repeated.by_others)[:, ~mask].ravel(), everywhere)
        helps = expected_bits(corrected_row, information) >= reached + _LEAST_GAIN_BITS
        if helps:
            row = corrected_row
            reached = expected_bits(row, information)
        if steps is None and number > 1 and reached < bits + _LEAST_GAIN_BITS:
            return _Measured(noise[:number], flat, bits)
        noise[number] = row
        flat = repeated.phases if helps else np.zeros_like(repeated.phases)
        bits = reached
    return _Measured(noise[: most + 1], flat, bits)


def _errors(graph: EstimatorGraph, page: KnownPhases, mask: NDArray[np.bool_], steps: int) -> NDArray[np.float64]:
    """Errors of the symbols' phases after so many steps, radians [ny, nx]."""
    (p,) = graph.run(["p"], page.feeds(mask), steps)
    error = wrapped(np.arctan2(p[1], p[0]).astype(np.float64) - page.phases)
    piston = np.angle(np.mean(np.exp(1j * error[mask])))
    return np.asarray(wrapped(error - piston))
