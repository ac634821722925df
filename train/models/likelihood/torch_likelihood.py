"""The likelihood of a page by torch, behind the numpy interface that calibration takes (`PageLikelihood`)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lightpage.calibration.likelihood.interfaces import Derivatives, Real, sampled_evenly
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.recording.frame_pair import FramePair
from lightpage.train.models.apart import Cameras
from lightpage.train.models.likelihood.estimator import Estimate, Operators, Page, PhaseEstimator

_SURE = 1e6
"""Concentration of known phases."""
_DEVICE = ("parameters", "blur", "illumination")
_CAMERAS = ("apart", "apart_beside", "apart_tilt")


class TorchLikelihood:
    """The likelihood of the pages of one device.

    Args:
        estimator: of the device.
    """

    def __init__(self, estimator: PhaseEstimator) -> None:
        self._estimator = estimator
        self._operators: tuple[list[bytes], Operators] | None = None
        self._pages: dict[int, tuple[FramePair, Page]] = {}

    def __call__(self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real) -> Derivatives:
        """See `PageLikelihood`."""
        tensors = {name: torch.from_numpy(np.array(value, order="C")) for name, value in table.items()}
        with torch.no_grad():
            operators, page = self.operators(table, tensors), self.page(pair, tensors)
            p = torch.from_numpy(_SURE * np.stack([np.cos(phases), np.sin(phases)])).float()
            still = torch.zeros_like(operators.illumination[0])
            estimate = Estimate(p, torch.from_numpy(np.asarray(nuisance)).float(), still)
            found = self._estimator.likelihood(operators, tensors, page, estimate, self.cameras(tensors))
        by_phase, by_nuisance = (part.numpy().astype(np.float64) for part in (found.by_phase, found.by_nuisance))
        (expected, counts), every = sampled_evenly(page.lit.numpy() > 0, found.expected.numpy(), page.counts.numpy())
        return Derivatives(by_phase, by_nuisance, expected, counts, every)

    def operators(self, table: SamplingTable, tensors: dict[str, Tensor]) -> Operators:
        """Operators of a device, made once."""
        key = [np.asarray(table[name]).tobytes() for name in _DEVICE]
        if self._operators is None or self._operators[0] != key:
            self._operators = key, self._estimator.operators(tensors)
        return self._operators[1]

    def page(self, pair: FramePair, tensors: dict[str, Tensor]) -> Page:
        """Measurements of a page, made once."""
        kept = self._pages.get(id(pair))
        if kept is None or kept[0] is not pair:
            frames = torch.from_numpy(pair.in_phase), torch.from_numpy(pair.quadrature)
            kept = pair, self._estimator.measured(tensors, *frames)[0]
            self._pages[id(pair)] = kept
        return kept[1]

    def cameras(self, tensors: dict[str, Tensor]) -> Cameras | None:
        """Defocus of cameras that stand apart, None where both see the same plane."""
        return self._estimator.recovery.cameras(*(tensors[name] for name in _CAMERAS if name in tensors))
