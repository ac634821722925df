"""Statistics, information and noise of a re-fitted device, measured with its estimator's own graphs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.likelihood.interfaces import Derivatives, ProgressCallback, Real, sampled_evenly
from lightpage.calibration.likelihood.measure import estimator_table, measured_statistics
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import known_p
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.execution.estimator_graph import NOISE, EstimatorGraph
from lightpage.runtime.recalibration.noise import KnownPhases, deviation_prior_scale, measured_noise

_FED = ("count_scale", "count_weights", "information", "responses", "nuisance_covariance", "nuisance_precision")
"""Tensors from which no wave operator is computed. They are fed with each evaluation."""


class GraphLikelihood:
    """Likelihood of a device's pages, computed by an estimator's graphs; see `PageLikelihood`.

    It keeps the operators and the pages' measurements of the last table.

    Args:
        graph: graph of a bundle of the same device. The device may have drifted since.
    """

    def __init__(self, graph: EstimatorGraph) -> None:
        self._graph = graph
        self._refitted = graph
        self._key: list[bytes] = []
        self._pages: dict[int, tuple[FramePair, dict[str, NDArray[Any]]]] = {}

    def __call__(self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real) -> Derivatives:
        """See `PageLikelihood`."""
        tensors = {name: np.asarray(value) for name, value in table.items() if name in self._graph.ports}
        fed = {name: value for name, value in tensors.items() if name in _FED}
        constants = {name: value for name, value in tensors.items() if name not in _FED}
        key = [value.tobytes() for value in constants.values()]
        if key != self._key:
            self._refitted = self._graph.with_table(constants)
            self._key = key
            self._pages = {}
        page = self._page(pair)
        outputs = self._refitted.derivatives(page, fed, known_p(phases), np.asarray(nuisance, np.float32))
        (expected, counts), stride = sampled_evenly(page["lit"] > 0, outputs["expected"], page["counts"])
        return Derivatives(
            by_phase=outputs["by_phase"].astype(np.float64),
            by_nuisance=outputs["by_nuisance"].astype(np.float64),
            expected=expected,
            counts=counts,
            stride=stride,
        )

    def _page(self, pair: FramePair) -> dict[str, NDArray[Any]]:
        """Measurements of a page, computed once for each pair of frames."""
        kept = self._pages.get(id(pair))
        if kept is None or kept[0] is not pair:  # an id may be that of an earlier pair, which is gone
            frames = {"in_phase": pair.in_phase, "quadrature": pair.quadrature}
            kept = pair, self._refitted.first_estimate(frames)
            self._pages[id(pair)] = kept
        return kept[1]


def measured_anew(
    graph: EstimatorGraph,
    twin: Twin,
    device: CalibratedDevice,
    pages: Sequence[KnownPage],
    conditions: LaunchConditions,
    mask: NDArray[np.bool_],
    progress: ProgressCallback,
) -> tuple[Statistics, SamplingTable]:
    """Measure what the estimator needs of a re-fitted device.

    Args:
        graph: graph of the bundle before the re-fit.
        twin: ray tracer of the nominal device.
        device: re-fitted device.
        pages: known pages.
        conditions: illumination and blur of the pages.
        mask: positions of the pilots, bool [ny, nx].
        progress: called with the finished share of the work.

    Returns:
        Statistics of the counts, and the tensors of the graph's table that change.

    Raises:
        CalibrationError: the pages' light does not agree with the device.
    """
    likelihood = GraphLikelihood(graph)
    statistics = measured_statistics(likelihood, twin, device, pages, conditions, lambda share: progress(0.4 * share))
    table = estimator_table(likelihood, twin, device, pages, statistics, lambda share: progress(0.4 + 0.4 * share))
    table = {name: value for name, value in table.items() if name in graph.ports}
    known = [KnownPhases.of(page, device) for page in pages]
    steps = len(graph.value(NOISE)) - 1
    prior_scale = deviation_prior_scale(device.profile, statistics)
    noise = measured_noise(graph.with_table(table), known, mask, prior_scale, steps)
    return statistics, table | noise
