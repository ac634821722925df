"""The likelihood of a page as calibration asks for it: torch computes it in training, ONNX Runtime in the runtime."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.recording.frame_pair import FramePair

Real = NDArray[np.float64]

ProgressCallback = Callable[[float], None]
"""Function that is called with the finished share of the work, 0 to 1. It may raise an exception to stop the work."""

MOST_SAMPLES = 400_000
"""Approximate limit of the samples of a camera from which statistics are measured."""


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a page's log-likelihood, and its counts.

    Attributes:
        by_phase: derivative by each symbol's phase, [ny, nx].
        by_nuisance: derivatives by the page's gain (relative change and phase), tilt and shift, [6].
        expected: counts that the light would give perfect cameras, [2, N], at evenly chosen samples of the common grid
            where both cameras have a reference.
        counts: measured counts at the same samples, [2, N].
        places: numbers of the chosen samples in the flattened grid, [N].
        stride: number of samples of the grid that each chosen one stands for.
    """

    by_phase: Real
    by_nuisance: Real
    expected: Real
    counts: Real
    places: NDArray[np.intp]
    stride: int


def chosen_evenly(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], int]:
    """Choose at most about `MOST_SAMPLES` samples of the grid evenly.

    Args:
        mask: samples that may be chosen, [Gy, Gx].

    Returns:
        Numbers of the chosen samples in the flattened grid, and the number of samples that each stands for.
    """
    places = np.flatnonzero(mask)
    stride = max(1, len(places) // MOST_SAMPLES)
    return places[::stride], stride


def at_places(planes: NDArray[np.float32], places: NDArray[np.intp]) -> Real:
    """Values of both cameras' planes [2, Gy, Gx] at places of the flattened grid, [2, N]."""
    return planes.reshape(len(planes), -1)[:, places].astype(np.float64)


class PageLikelihood(Protocol):
    """Log-likelihood of the phases of a page of one device."""

    def apart_inputs(self, device: CalibratedDevice) -> tuple[str, ...]:
        """Return the names of the tensors of cameras in different planes that the likelihood takes for a device."""
        ...

    def __call__(self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real) -> Derivatives:
        """Evaluate the derivatives.

        Args:
            pair: frames of the page.
            table: table of the device, see `lightpage.calibration.likelihood.table`.
            phases: phases of the symbols' light, radians [ny, nx].
            nuisance: gain (real and imaginary part), tilt (x, y), radians, and shift (x, y), camera pixels, [6].
        """
        ...

    def expected(
        self, pair: FramePair, table: SamplingTable, phases: Real, nuisance: Real, places: NDArray[np.intp]
    ) -> Real:
        """Evaluate the expected counts alone, [2, N].

        Args:
            pair, table, phases, nuisance: as above.
            places: numbers of samples in the flattened grid, [N].
        """
        ...
