"""Statistics, information and noise of a re-fitted device, measured with its estimator's own graphs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.likelihood.interfaces import Derivatives, ProgressCallback, Real, at_places, chosen_evenly
from lightpage.calibration.likelihood.measure import estimator_table
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.likelihood.table import FLAT_FIELD, MEASUREMENT_INPUTS, known_p
from lightpage.calibration.sampling_table import APART, SamplingTable
from lightpage.errors import CalibrationError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.execution.estimator_graph import CHI_SQUARE, DERIVATIVES, NOISE, EstimatorGraph
from lightpage.runtime.recalibration.noise import MOST_STEPS, KnownPhases, deviation_prior_scale, measured_noise

_FED = ("count_scale", "count_weights", "information", "responses", "nuisance_covariance", "nuisance_precision")
"""Tensors from which no wave operator is computed. They are fed with each evaluation."""
MOST_CHI_SQUARE = 2.0
"""Largest mean square of a known page's residuals over their variance. It is 1 with the calibration's own references.
A small device's page has 5.5 with references at 0.9 times the exposure, 11 with mirrored references, and 3.3 with
references that are shifted by 20 pixels."""


class GraphLikelihood:
    """Likelihood of a device's pages, computed by an estimator's graphs; see `PageLikelihood`.

    It keeps the operators and the pages' measurements of the last table.

    Args:
        graph: graph of a bundle of the same device. The device may have drifted since.

    Attributes:
        graph: as given.
    """

    def __init__(self, graph: EstimatorGraph) -> None:
        self.graph = graph
        self._refitted = graph
        self._key: list[bytes] = []
        self._measured_by: list[bytes] = []
        self._pages: dict[int, tuple[FramePair, dict[str, NDArray[Any]]]] = {}

    def apart_inputs(self, device: CalibratedDevice) -> tuple[str, ...]:
        """See `PageLikelihood`. A graph takes the same tensors whatever the device needs."""
        return tuple(name for name in APART if name in self.graph.ports)

    def __call__(self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real) -> Derivatives:
        """See `PageLikelihood`."""
        page, outputs = self._outputs(pair, table, phases, nuisance, DERIVATIVES)
        places, stride = chosen_evenly(page["lit"] > 0)
        return Derivatives(
            by_phase=outputs["by_phase"].astype(np.float64),
            by_nuisance=outputs["by_nuisance"].astype(np.float64),
            expected=at_places(outputs["expected"], places),
            counts=at_places(page["counts"], places),
            places=places,
            stride=stride,
        )

    def expected(
        self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real, places: NDArray[np.intp]
    ) -> Real:
        """See `PageLikelihood`."""
        _, outputs = self._outputs(pair, table, phases, nuisance, ("expected",))
        return at_places(outputs["expected"], places)

    def _outputs(
        self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real, names: Sequence[str]
    ) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
        """Compute the measurements of a page, and outputs of a step at an estimate, by name."""
        tensors = {name: np.asarray(value) for name, value in table.items() if name in self.graph.ports}
        fed = {name: value for name, value in tensors.items() if name in _FED}
        constants = {name: value for name, value in tensors.items() if name not in _FED}
        key = [value.tobytes() for value in constants.values()]
        if key != self._key:
            self._refitted = self.graph.with_table(constants)
            self._key = key
        measured_by = [tensors[name].tobytes() for name in MEASUREMENT_INPUTS if name in tensors]
        if measured_by != self._measured_by:
            self._measured_by = measured_by
            self._pages = {}
        page = self._page(pair)
        return page, self._refitted.derivatives(page, fed, known_p(phases), np.asarray(nuisance, np.float32), names)

    def _page(self, pair: FramePair) -> dict[str, NDArray[Any]]:
        """Measurements of a page, computed once for each pair of frames."""
        kept = self._pages.get(id(pair))
        if kept is None or kept[0] is not pair:  # an id may be that of an earlier pair, which is gone
            frames = {"in_phase": pair.in_phase, "quadrature": pair.quadrature}
            kept = pair, self._refitted.first_estimate(frames)
            self._pages[id(pair)] = kept
        return kept[1]


def measured_table(
    likelihood: GraphLikelihood,
    twin: Twin,
    device: CalibratedDevice,
    pages: Sequence[KnownPage],
    statistics: Statistics,
    mask: NDArray[np.bool_],
    progress: ProgressCallback,
) -> SamplingTable:
    """Measure the tensors of the graph's table that change with a re-fit.

    Args:
        likelihood: likelihood by the graph of the bundle before the re-fit.
        twin: ray tracer of the nominal device.
        device: re-fitted device.
        pages: known pages.
        statistics: statistics of the re-fitted device.
        mask: positions of the pilots, bool [ny, nx].
        progress: called with the finished share of the work.
    """
    graph = likelihood.graph
    table = estimator_table(likelihood, twin, device, pages, statistics, lambda share: progress(0.6 * share))
    table = {name: value for name, value in table.items() if name in graph.ports}
    known = [KnownPhases.of(page, device) for page in pages]
    steps = len(graph.value(NOISE)) - 1
    prior_scale = deviation_prior_scale(device.profile, statistics)
    earlier = graph.value(FLAT_FIELD) if FLAT_FIELD in graph.ports else None
    return table | measured_noise(graph.with_table(table), known, mask, prior_scale, steps, earlier)


def check_counts(graph: EstimatorGraph, known: KnownPhases, mask: NDArray[np.bool_], subject: str) -> None:
    """Check that a known page's counts scatter about the expected counts as the calibration's statistics say.

    Args:
        graph: graph of the calibrated device.
        known: page of the calibration.
        mask: positions of the pilots, bool [ny, nx].
        subject: name of the page, for the error.

    Raises:
        CalibrationError: the counts scatter more, as with references other than those of the calibration.
    """
    feeds = known.feeds(mask)
    page = graph.first_estimate(feeds)
    p = known_p(known.phases)
    nuisance = page["nuisance"]
    chi_square = np.inf
    for _ in range(MOST_STEPS):
        outputs = graph.derivatives(page, feeds, p, nuisance, ("nuisance", CHI_SQUARE))
        nuisance = outputs["nuisance"]
        chi_square = float(outputs[CHI_SQUARE])
    if not chi_square <= MOST_CHI_SQUARE:
        got = f"counts that scatter {chi_square:.3g} times as much as the calibration says"
        expected = f"at most {MOST_CHI_SQUARE:g} times; are these the calibration's references? Or calibrate anew"
        raise CalibrationError(subject, got, expected)
