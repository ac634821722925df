"""The likelihood of a page as calibration asks for it, computed by torch in training and by ONNX in the runtime."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.recording.frame_pair import FramePair

Real = NDArray[np.float64]

MOST_SAMPLES = 400_000
"""Samples of a camera that statistics are taken of, about."""


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a page's log-likelihood, and its counts.

    Attributes:
        by_phase: derivative by each symbol's phase, [ny, nx].
        by_nuisance: derivatives by the page's gain (relative change and phase), tilt and shift, [6].
        expected: counts that the light would give perfect cameras, on an even share of the grid where both cameras have
            a reference, [2, N].
        counts: counts that came there, [2, N].
        every: samples for which each of these stands.
    """

    by_phase: Real
    by_nuisance: Real
    expected: Real
    counts: Real
    every: int


def sampled_evenly(lit: NDArray[np.bool_], *planes: NDArray[np.float32]) -> tuple[list[Real], int]:
    """Samples of planes [2, Gy, Gx] where `lit` [Gy, Gx] is set, [2, N] each, and how many each stands for."""
    every = max(1, int(np.count_nonzero(lit)) // MOST_SAMPLES)
    return [plane[:, lit][:, ::every].astype(np.float64) for plane in planes], every


class PageLikelihood(Protocol):
    """Log-likelihood of the phases of a page of one device."""

    def __call__(self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real) -> Derivatives:
        """Evaluate the derivatives.

        Args:
            pair: frames of the page.
            table: table of the device, see `lightpage.calibration.likelihood.table`.
            phases: phases of the symbols' light, radians [ny, nx].
            nuisance: gain (real and imaginary part), tilt (x, y), radians, and shift (x, y), camera pixels, [6].
        """
        ...
