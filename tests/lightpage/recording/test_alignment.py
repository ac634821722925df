"""Counts in the high bits are told from counts in the low ones, and from pictures that happen to look so."""

from __future__ import annotations

import numpy as np
import pytest

from lightpage.errors import FrameError
from lightpage.recording.alignment import check_alignment, empty_low_bits

RNG = np.random.default_rng(1)
COUNTS = RNG.integers(0, 1 << 10, (40, 50)).astype(np.uint16)


@pytest.mark.parametrize("shift", [2, 4, 6])
def test_left_aligned_counts_are_named_with_their_bits(shift: int) -> None:
    assert empty_low_bits(COUNTS << shift) == shift
    with pytest.raises(FrameError, match=f"multiples of {1 << shift}: {16 - shift} bits"):
        check_alignment("frame", COUNTS << shift, 16)


@pytest.mark.parametrize(
    "frame",
    [
        COUNTS,
        COUNTS * 2,
        np.zeros((8, 8), np.uint16),
        np.full((8, 8), 4096, np.uint16),
        (COUNTS & 7) << 8,
        np.where(COUNTS > 500, COUNTS << 4, COUNTS),
    ],
    ids=["right", "gain of two", "black", "flat", "coarse", "some"],
)
def test_other_counts_are_taken(frame: np.ndarray) -> None:
    check_alignment("frame", frame, 12)


def test_eight_bits_have_no_other_place() -> None:
    check_alignment("frame", (COUNTS << 2).astype(np.uint8), 8)
