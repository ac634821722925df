"""Statistics, information and noise of an estimator's device, measured anew by its own graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.likelihood.interfaces import Derivatives, Real, sampled_evenly
from lightpage.calibration.likelihood.measure import estimator_table, measured_statistics
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.execution.estimator_graph import NOISE, EstimatorGraph
from lightpage.runtime.recalibration.noise import measured_noise
from lightpage.waves.grid import symbol_samples

KNOWN_CONCENTRATION = 1e6
"""Concentration of known phases."""
_OF_COUNTS = ("count_scale", "count_weights", "information", "responses", "nuisance_covariance", "nuisance_precision")
"""Tensors that no constant follows from: they are fed with each evaluation."""


class GraphLikelihood:
    """The likelihood of a device's pages by an estimator's graphs; see `PageLikelihood`.

    Args:
        graph: of a bundle of the same device, drifted or not.
    """

    def __init__(self, graph: EstimatorGraph) -> None:
        self._graph = self._own = graph
        self._key: list[bytes] = []
        self._pages: dict[int, tuple[FramePair, dict[str, NDArray[Any]]]] = {}

    def __call__(self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real) -> Derivatives:
        """See `PageLikelihood`."""
        own = {name: np.asarray(value) for name, value in table.items() if name in self._graph.ports}
        fixed = {name: value for name, value in own.items() if name not in _OF_COUNTS}
        key = [value.tobytes() for value in fixed.values()]
        if key != self._key:
            self._own, self._key, self._pages = self._graph.with_table(fixed), key, {}
        kept = self._pages.get(id(pair))
        if kept is None or kept[0] is not pair:
            measured = self._own.begun({"in_phase": pair.in_phase, "quadrature": pair.quadrature})
            kept = self._pages[id(pair)] = pair, measured
        page = kept[1]
        p = (KNOWN_CONCENTRATION * np.stack([np.cos(phases), np.sin(phases)])).astype(np.float32)
        fed = {name: own[name] for name in _OF_COUNTS if name in own}
        found = self._own.derivatives(page, fed, p, np.asarray(nuisance, np.float32))
        (expected, counts), every = sampled_evenly(page["lit"] > 0, found["expected"], page["counts"])
        by_phase, by_nuisance = (found[name].astype(np.float64) for name in ("by_phase", "by_nuisance"))
        return Derivatives(by_phase, by_nuisance, expected, counts, every)


def measured_anew(
    graph: EstimatorGraph,
    twin: Twin,
    device: CalibratedDevice,
    pages: Sequence[KnownPage],
    conditions: LaunchConditions,
    mask: NDArray[np.bool_],
    progress: Callable[[float], None],
) -> tuple[Statistics, SamplingTable]:
    """Measure what the estimator needs of a re-fitted device.

    Args:
        graph: of the bundle of before.
        twin: ray tracer of the nominal device.
        device: re-fitted device.
        pages: known pages.
        conditions: illumination and blur of its pages.
        mask: places of the pilots, bool [ny, nx].
        progress: function that takes the share of the work that is done.

    Returns:
        Statistics, and the tensors of the table.
    """
    likelihood = GraphLikelihood(graph)
    statistics = measured_statistics(likelihood, twin, device, pages, conditions, lambda share: progress(0.4 * share))
    table = estimator_table(likelihood, twin, device, pages, statistics, lambda share: progress(0.4 + 0.4 * share))
    table = {name: value for name, value in table.items() if name in graph.ports}
    known = [(page.pair, np.angle(page.light(device.modulation))) for page in pages]
    steps = len(graph.value(NOISE)) - 1
    prior_scale = symbol_samples(device.profile) ** 2 * statistics.correlation
    noise = measured_noise(graph.with_table(table), known, mask, prior_scale, steps)
    return statistics, table | noise
