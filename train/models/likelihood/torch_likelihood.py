"""Likelihood of a page by torch, with the numpy interface of calibration (`PageLikelihood`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.likelihood.interfaces import Derivatives, Real, at_places, chosen_evenly
from lightpage.calibration.likelihood.table import MEASUREMENT_INPUTS, known_p
from lightpage.calibration.sampling_table import APART, SamplingTable
from lightpage.recording.frame_pair import FramePair
from lightpage.train.models.apart import Cameras
from lightpage.train.models.likelihood.estimator import (
    OPERATOR_INPUTS,
    Estimate,
    Operators,
    Page,
    PhaseEstimator,
)


class _State(NamedTuple):
    """Arguments of `PhaseEstimator.likelihood`."""

    operators: Operators
    tensors: dict[str, Tensor]
    page: Page
    estimate: Estimate
    cameras: Cameras | None


class TorchLikelihood:
    """Likelihood of the pages of one device.

    It keeps the operators and the pages' measurements of the last table.

    Args:
        estimator: estimator of the device.
    """

    def __init__(self, estimator: PhaseEstimator) -> None:
        self._estimator = estimator
        self._operators: tuple[list[bytes], Operators] | None = None
        self._measured_by: list[bytes] = []
        self._pages: dict[int, tuple[FramePair, Page]] = {}

    def apart_inputs(self, device: CalibratedDevice) -> tuple[str, ...]:
        """See `PageLikelihood`."""
        return device.apart_inputs

    def __call__(self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real) -> Derivatives:
        """See `PageLikelihood`."""
        state = self._state(pair, table, phases, nuisance)
        with torch.no_grad():
            likelihood = self._estimator.likelihood(*state)
        page = state.page
        places, stride = chosen_evenly(page.lit.numpy() > 0)
        return Derivatives(
            by_phase=likelihood.by_phase.numpy().astype(np.float64),
            by_nuisance=likelihood.by_nuisance.numpy().astype(np.float64),
            expected=at_places(likelihood.expected.numpy(), places),
            counts=at_places(page.counts.numpy(), places),
            places=places,
            stride=stride,
        )

    def expected(
        self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real, places: NDArray[np.intp]
    ) -> Real:
        """See `PageLikelihood`."""
        with torch.no_grad():
            expected = self._estimator.expected_counts(*self._state(pair, table, phases, nuisance))
        return at_places(expected.numpy(), places)

    def _state(self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real) -> _State:
        """Return the arguments of an evaluation."""
        tensors = {name: torch.from_numpy(np.array(value, order="C")) for name, value in table.items()}
        with torch.no_grad():
            operators = self.operators(table, tensors)
            page = self.page(pair, table, tensors)
            cameras = self.cameras(tensors)
        p = torch.from_numpy(known_p(phases))
        no_deviations = torch.zeros_like(operators.illumination[0])
        estimate = Estimate(p, torch.from_numpy(np.asarray(nuisance)).float(), no_deviations)
        return _State(operators, tensors, page, estimate, cameras)

    def operators(self, table: SamplingTable, tensors: dict[str, Tensor]) -> Operators:
        """Wave operators of a device, computed once."""
        key = _contents(table, OPERATOR_INPUTS)
        if self._operators is None or self._operators[0] != key:
            self._operators = key, self._estimator.operators(tensors)
        return self._operators[1]

    def page(self, pair: FramePair, table: SamplingTable, tensors: dict[str, Tensor]) -> Page:
        """Measurements of a page, computed once for each pair of frames."""
        key = _contents(table, MEASUREMENT_INPUTS)
        if key != self._measured_by:
            self._measured_by, self._pages = key, {}
        kept = self._pages.get(id(pair))
        if kept is None or kept[0] is not pair:  # an id may be that of an earlier pair, which is gone
            frames = torch.from_numpy(pair.in_phase), torch.from_numpy(pair.quadrature)
            kept = pair, self._estimator.measured(tensors, *frames)[0]
            self._pages[id(pair)] = kept
        return kept[1]

    def cameras(self, tensors: dict[str, Tensor]) -> Cameras | None:
        """Defocus of cameras that stand apart, None where both see the same plane."""
        return self._estimator.recovery.cameras(*(tensors[name] for name in APART if name in tensors))


def _contents(table: SamplingTable, names: tuple[str, ...]) -> list[bytes]:
    """Contents of the tensors with these names, as far as the table has them."""
    return [np.asarray(table[name]).tobytes() for name in names if name in table]
