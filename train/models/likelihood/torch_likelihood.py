"""Likelihood of a page by torch, with the numpy interface of calibration (`PageLikelihood`)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lightpage.calibration.likelihood.interfaces import Derivatives, Real, sampled_evenly
from lightpage.calibration.likelihood.table import known_p
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

_MEASUREMENT_INPUTS = ("reference_in_phase", "reference_quadrature", "registration", "homodyne", *APART)


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

    def __call__(self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real) -> Derivatives:
        """See `PageLikelihood`."""
        tensors = {name: torch.from_numpy(np.array(value, order="C")) for name, value in table.items()}
        with torch.no_grad():
            operators = self.operators(table, tensors)
            page = self.page(pair, table, tensors)
            no_deviations = torch.zeros_like(operators.illumination[0])
            p, parameters = torch.from_numpy(known_p(phases)), torch.from_numpy(np.asarray(nuisance)).float()
            estimate = Estimate(p, parameters, no_deviations)
            likelihood = self._estimator.likelihood(operators, tensors, page, estimate, self.cameras(tensors))
        mask, expected, counts = page.lit.numpy() > 0, likelihood.expected.numpy(), page.counts.numpy()
        (expected_samples, count_samples), stride = sampled_evenly(mask, expected, counts)
        return Derivatives(
            by_phase=likelihood.by_phase.numpy().astype(np.float64),
            by_nuisance=likelihood.by_nuisance.numpy().astype(np.float64),
            expected=expected_samples,
            counts=count_samples,
            stride=stride,
        )

    def operators(self, table: SamplingTable, tensors: dict[str, Tensor]) -> Operators:
        """Wave operators of a device, computed once."""
        key = _contents(table, OPERATOR_INPUTS)
        if self._operators is None or self._operators[0] != key:
            self._operators = key, self._estimator.operators(tensors)
        return self._operators[1]

    def page(self, pair: FramePair, table: SamplingTable, tensors: dict[str, Tensor]) -> Page:
        """Measurements of a page, computed once for each pair of frames."""
        key = _contents(table, _MEASUREMENT_INPUTS)
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
