"""Whether a camera frame shows light that can be used: counts within the bit depth, neither black nor saturated."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import BlackFrameError, FrameError, SaturatedFrameError
from lightpage.recording.alignment import describe, greatest_count, unused_low_bits
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import MIN_BIT_DEPTH

BLACK_FRACTION = 0.02
"""A frame whose brightest pixel is below this share of full scale is dark: its laser or its shutter is off."""

SATURATED_FRACTION = 0.05
"""Share of pixels at full scale from which on a frame is overexposed; speckle peaks clip about one in a hundred."""


def check_pair_light(subject: str, pair: FramePair, bit_depth: int) -> None:
    """Check the counts of both frames of a pair; `subject` goes before the frame's name in the error.

    Raises:
        FrameError: see `check_light`.
    """
    check_light(f"{subject}in-phase frame", pair.in_phase, bit_depth)
    check_light(f"{subject}quadrature frame", pair.quadrature, bit_depth)


def check_light(name: str, frame: NDArray[np.integer[Any]], bit_depth: int) -> None:
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
