"""Notices counts that lie at the upper end of their bits, as 12 bits do in `Mono16` of many cameras.

Such counts are multiples, of 16 for 12 bits in 16. They are as good as others, but their greatest one, 4095 * 16, is
not full scale, so that saturation would go unseen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.recording.layout import MIN_BIT_DEPTH

Counts = NDArray[np.integer[Any]]

_LEAST_DISTINCT = 32
"""Different counts that tell: by chance none of so many is odd in one of 2**32 frames. A dark frame has fewer."""
_SAMPLE = 1 << 16


def unused_low_bits(frame: Counts, bit_depth: int) -> int | None:
    """How many of the lowest bits no count of a frame uses.

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
    """For people, what counts are whose lowest bits are not used."""
    return f"counts that are multiples of {2**unused}: {bit_depth - unused} bits left-aligned in {bit_depth}"
