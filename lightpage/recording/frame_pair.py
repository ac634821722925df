"""The pair of frames that a page is read from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError
from lightpage.words import brief, sides


@dataclass(frozen=True, repr=False)
class FramePair:
    """The two frames of one page, camera counts [row, column]."""

    in_phase: NDArray[np.integer[Any]]
    quadrature: NDArray[np.integer[Any]]

    def __repr__(self) -> str:
        return brief(self, *(f"{name} {_counts(frame)}" for name, frame in vars(self).items()))


def check_pair(pair: object, subject: str = "") -> None:
    """Check that what a caller gives is a pair; `subject` goes before it in the error.

    Raises:
        FrameError: it has no frames of two cameras.
    """
    if not (hasattr(pair, "in_phase") and hasattr(pair, "quadrature")):
        raise FrameError(f"{subject}frames", type(pair).__name__, "a FramePair of both cameras")


def _counts(frame: NDArray[np.integer[Any]]) -> str:
    spread = f" of {frame.min()} to {frame.max()}" if frame.size else ""
    return f"{sides(frame.shape)} {frame.dtype}{spread}"
