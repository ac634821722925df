"""Checks of a camera frame's exposure: counts within the bit depth, neither black nor saturated.

Counts may lie at the upper end of their bits, as 12 bits do in `Mono16` of many cameras. Such counts are multiples, of
16 for 12 bits in 16. They are as good as others, but their greatest one, 4095 * 16, is not full scale, so that
saturation would go unseen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import BlackFrameError, FrameError, FramesDisagreeError, SaturatedFrameError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import MIN_BIT_DEPTH

Counts = NDArray[np.integer[Any]]

BLACK_FRACTION = 0.02
"""A frame whose brightest pixel is below this share of full scale is dark: its laser or its shutter is off."""

SATURATED_FRACTION = 0.05
"""Share of pixels at full scale from which on a frame is overexposed; speckle peaks clip about one in a hundred."""

_LEAST_DISTINCT = 32
"""Different counts that tell: by chance none of so many is odd in one of 2**32 frames. A dark frame has fewer."""
_SAMPLE = 1 << 16


def check_pair_light(subject: str, pair: FramePair, bit_depth: int) -> None:
    """Check the counts of both frames of a pair; `subject` goes before the frame's name in the error.

    Raises:
        FrameError: see `check_light`.
    """
    check_light(f"{subject}in-phase frame", pair.in_phase, bit_depth)
    check_light(f"{subject}quadrature frame", pair.quadrature, bit_depth)


def check_different(name: str, first: Counts, second: Counts, other: str) -> None:
    """Check that a frame is not the other camera's too: noise alone tells two exposures apart.

    Args:
        name: of the second frame, for the error.
        first: counts [H, W] of one camera.
        second: counts of the other one.
        other: name of the first frame.

    Raises:
        FramesDisagreeError: all counts are equal, and not all the same.
    """
    if np.array_equal(first, second) and first.min() < first.max():
        raise FramesDisagreeError(name, f"the same counts as {other}", "the other camera's")


def check_light(name: str, frame: Counts, bit_depth: int) -> None:
    """Check the counts of one frame.

    Args:
        name: of the frame, for the error.
        frame: counts [H, W].
        bit_depth: bits of a camera count.

    Raises:
        FrameError: beyond the bit depth, black or saturated.
    """
    full_scale = (1 << bit_depth) - 1
    peak = int(frame.max())
    if peak > full_scale:
        raise FrameError(name, f"a count of {peak}", f"at most {full_scale} ({bit_depth} bits)")
    if peak <= BLACK_FRACTION * full_scale:
        raise BlackFrameError(name, f"black: no count above {peak}", f"counts above {BLACK_FRACTION * full_scale:.0f}")
    if peak < greatest_count(bit_depth, bit_depth - MIN_BIT_DEPTH):
        return
    unused = 0 if peak == full_scale else unused_low_bits(frame, bit_depth) or 0
    clipped = np.count_nonzero(frame >= greatest_count(bit_depth, unused)) / frame.size
    if clipped > SATURATED_FRACTION:
        of = f" of {describe(bit_depth, unused)}" if unused else ""
        raise SaturatedFrameError(
            name, f"saturated: {clipped:.1%} at full scale{of}", f"at most {SATURATED_FRACTION:.0%}"
        )


def unused_low_bits(frame: Counts, bit_depth: int) -> int | None:
    """Return how many of the lowest bits no count of a frame uses.

    Args:
        frame: counts [row, column].
        bit_depth: bits of a count.

    Returns:
        0 where the lowest bit is used, and so many that 8 bits are left at most; None where the different counts are
        too few to tell, as of a dark frame.
    """
    flat = frame.reshape(-1)
    sample = flat[:: max(1, flat.size // _SAMPLE)]
    if bit_depth <= MIN_BIT_DEPTH or int(np.bitwise_or.reduce(sample, initial=0)) & 1:
        return 0
    used = int(np.bitwise_or.reduce(flat, initial=0))
    if used & 1:
        return 0
    unused = min((used & -used).bit_length() - 1, bit_depth - MIN_BIT_DEPTH) if used else 0
    return unused if len(np.unique(sample)) >= _LEAST_DISTINCT else None


def greatest_count(bit_depth: int, unused: int) -> int:
    """The greatest count of so many bits, whose lowest `unused` ones are not used."""
    return ((1 << bit_depth) - 1) >> unused << unused


def describe(bit_depth: int, unused: int) -> str:
    """Describe counts whose lowest bits are not used."""
    return f"counts that are multiples of {2**unused}: {bit_depth - unused} bits left-aligned in {bit_depth}"
