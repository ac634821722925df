"""Noise of an estimator's phases after each step, measured on known pages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.likelihood.noise import expected_bits, fitted_noise
from lightpage.calibration.likelihood.table import pilot_tensors
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.page.correction import wrapped
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.execution.estimator_graph import (
    DEVIATION_PRECISION,
    NO_DEVIATIONS,
    NOISE,
    EstimatorGraph,
)

KnownPhases = tuple[FramePair, NDArray[np.float64]]
"""Frames of a known page, and the phases of its light, radians [ny, nx]."""
MOST_STEPS = 6
"""Gauss-Newton steps, at most."""
_GAIN_BITS = 0.004
"""Information that another step must gain, bits a symbol."""


def measured_noise(
    graph: EstimatorGraph,
    pages: Sequence[KnownPhases],
    mask: NDArray[np.bool_],
    prior_scale: float,
    steps: int | None = None,
) -> SamplingTable:
    """Fit the noise after each step, from that of the first estimate on, and the modulator's deviations.

    Deviations of the modulator's samples are estimated where known pages are read better by it.

    Args:
        graph: graph of the device, with at least as many steps.
        pages: known pages.
        mask: places of the pilots, bool [ny, nx].
        prior_scale: variance of a sample's deviation over that of a symbol's phase: the samples of a symbol, times
            the statistics' correlation, by which the likelihood weighs the counts less than a page's noise alone would.
        steps: number of steps; as many as gain information if left out.

    Returns:
        `NOISE` [steps + 1, 2] and `DEVIATION_PRECISION` [].
    """
    information = graph.value("information")[~mask].astype(np.float64)
    without, bits = _noise_by_step(graph.with_table({DEVIATION_PRECISION: NO_DEVIATIONS}), pages, mask, steps)
    variance = float(np.mean(without[-1, 0] / information + without[-1, 1]))
    precision = np.array(1 / (prior_scale * variance), np.float32)
    estimated, more_bits = _noise_by_step(graph.with_table({DEVIATION_PRECISION: precision}), pages, mask, steps)
    if more_bits < bits + _GAIN_BITS:
        return {NOISE: without, DEVIATION_PRECISION: NO_DEVIATIONS}
    return {NOISE: estimated, DEVIATION_PRECISION: precision}


def _noise_by_step(
    graph: EstimatorGraph, pages: Sequence[KnownPhases], mask: NDArray[np.bool_], steps: int | None
) -> tuple[NDArray[np.float32], float]:
    """Noise after each step [steps + 1, 2], and information after the last one, bits a symbol."""
    most = MOST_STEPS if steps is None else steps
    noise = np.tile(np.array([1, 0], np.float32), (len(graph.value(NOISE)), 1))
    information = graph.value("information")[~mask].astype(np.float64)
    bits: list[float] = []
    for number in range(most + 1):
        graph = graph.with_table({NOISE: noise})
        errors = [_errors(graph, pair, phases, mask, number) for pair, phases in pages]
        noise[number] = fitted_noise(np.concatenate(errors), np.tile(information, len(pages)))
        bits.append(expected_bits(noise[number], information))
        if steps is None and number > 1 and bits[-1] < bits[-2] + _GAIN_BITS:
            return noise[:number], bits[-2]
    return noise[: most + 1], bits[-1]


def _errors(
    graph: EstimatorGraph, pair: FramePair, phases: NDArray[np.float64], mask: NDArray[np.bool_], steps: int
) -> NDArray[np.float64]:
    """Errors of the data symbols' phases after so many steps, radians, 1-D."""
    pilots = Pilots(mask, phases[mask])
    feeds = {"in_phase": pair.in_phase, "quadrature": pair.quadrature, **pilot_tensors(pilots)}
    (p,) = graph.run(["p"], feeds, steps)
    error = wrapped(np.arctan2(p[1], p[0]).astype(np.float64) - phases)
    piston = np.angle(np.mean(np.exp(1j * error[mask])))
    return np.asarray(wrapped(error - piston)[~mask])
