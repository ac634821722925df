"""Counts that lie in the high bits of their type, as many cameras send them, where the low bits are wanted."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError, LightpageError

_FEWEST_BITS = 2
"""Low bits that are zero in every count: one may be a camera's gain."""
_FEWEST_VALUES = 32
"""Different counts of a frame of which its low bits can be told; a flat or coarse picture has fewer."""


def empty_low_bits(frame: NDArray[np.integer[Any]]) -> int:
    """How many of the lowest bits are zero in all counts of a frame, 0 where that may be chance.

    Args:
        frame: counts [row, column].
    """
    used = int(np.bitwise_or.reduce(frame, axis=None))
    empty = (used & -used).bit_length() - 1
    if empty < _FEWEST_BITS or len(np.unique(frame)) < _FEWEST_VALUES:
        return 0
    return empty


def check_alignment(
    name: str, frame: NDArray[np.integer[Any]], bit_depth: int, failure: type[LightpageError] = FrameError
) -> None:
    """Check that the counts of a frame are right-aligned.

    Args:
        name: of the frame, for the error.
        frame: counts [row, column].
        bit_depth: bits of a count, as the frame is said to have.
        failure: class of the error.

    Raises:
        LightpageError: of class `failure`: their low bits are empty, so that full scale is never reached.
    """
    if bit_depth > 8 and (empty := empty_low_bits(frame)):
        got = f"counts that are all multiples of {1 << empty}: {bit_depth - empty} bits, left-aligned in {bit_depth}"
        expected = f"right-aligned counts: divide them by {1 << empty}, or have Mono{bit_depth - empty} sent"
        raise failure(name, got, f"{expected}, and a bit depth of {bit_depth - empty}")
