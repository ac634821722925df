"""Noise of an estimator's phases after each step, measured on known pages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.likelihood.noise import expected_bits, fitted_noise
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import pilot_tensors
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
"""Least gain of information for another step, and for the estimation of deviations, bits a symbol."""


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
    """Measure the noise of the first estimate and after each step, and the prior of the modulator's deviations.

    Deviations of the modulator's samples are estimated only if known pages are read better with them.

    Args:
        graph: graph of the device, with at least `steps` steps, or `MOST_STEPS` if these are left out.
        pages: known pages.
        mask: positions of the pilots, bool [ny, nx].
        prior_scale: see `deviation_prior_scale`.
        steps: number of steps; if left out, as many as gain information.

    Returns:
        `NOISE` [steps + 1, 2] and `DEVIATION_PRECISION` [].
    """
    information = graph.value("information")[~mask].astype(np.float64)
    fixed_graph = graph.with_table({DEVIATION_PRECISION: NO_DEVIATIONS})
    fixed, fixed_bits = _noise_by_step(fixed_graph, pages, mask, steps)
    variance = float(np.mean(fixed[-1, 0] / information + fixed[-1, 1]))
    precision = np.array(1 / (prior_scale * variance), np.float32)
    fitted, fitted_bits = _noise_by_step(graph.with_table({DEVIATION_PRECISION: precision}), pages, mask, steps)
    if fitted_bits < fixed_bits + _LEAST_GAIN_BITS:
        return {NOISE: fixed, DEVIATION_PRECISION: NO_DEVIATIONS}
    return {NOISE: fitted, DEVIATION_PRECISION: precision}


def _noise_by_step(
    graph: EstimatorGraph, pages: Sequence[KnownPhases], mask: NDArray[np.bool_], steps: int | None
) -> tuple[NDArray[np.float32], float]:
    """Measure the noise after each step, [steps + 1, 2], and the information after the last one, bits a symbol."""
    most = MOST_STEPS if steps is None else steps
    noise = np.tile(np.array([1, 0], np.float32), (len(graph.value(NOISE)), 1))
    information = graph.value("information")[~mask].astype(np.float64)
    bits: list[float] = []
    for number in range(most + 1):
        graph = graph.with_table({NOISE: noise})
        errors = [_errors(graph, page, mask, number) for page in pages]
        noise[number] = fitted_noise(np.concatenate(errors), np.tile(information, len(pages)))
        bits.append(expected_bits(noise[number], information))
        if steps is None and number > 1 and bits[-1] < bits[-2] + _LEAST_GAIN_BITS:
            return noise[:number], bits[-2]
    return noise[: most + 1], bits[-1]


def _errors(graph: EstimatorGraph, page: KnownPhases, mask: NDArray[np.bool_], steps: int) -> NDArray[np.float64]:
    """Errors of the data symbols' phases after so many steps, radians, 1-D."""
    (p,) = graph.run(["p"], page.feeds(mask), steps)
    error = wrapped(np.arctan2(p[1], p[0]).astype(np.float64) - page.phases)
    piston = np.angle(np.mean(np.exp(1j * error[mask])))
    return np.asarray(wrapped(error - piston)[~mask])
