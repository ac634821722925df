"""Information of a page's bits in their LLRs, quickly: to about 1e-7 of a bit, alike in numpy and compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.compiled.choice import compiled
from lightpage.codec.likelihood.arithmetic import LEAST_EXPONENT, Float32, exponential, logarithm

_UNITS = np.float32(2**24)
"""Units in a nat: whole numbers of them have the same sum in any order."""
_CHUNK = 1 << 14


def page_information(llrs: Float32, bits: NDArray[np.uint8] | None = None) -> float:
    """Mean information of bits: what `bit_information` gives, in float32.

    Args:
        llrs: ln P(0) / P(1), clipped, contiguous.
        bits: the true ones, the same shape.
    """
    native = compiled()
    if native is not None:
        lack: int = native.lack_of_information(llrs, bits)
    else:
        flat, right = llrs.ravel(), None if bits is None else bits.ravel()
        parts = [slice(start, start + _CHUNK) for start in range(0, flat.size, _CHUNK)]
        lack = sum(_lack(flat[part], None if right is None else right[part]) for part in parts)
    return 1 - lack / float(_UNITS) / llrs.size / float(np.log(2))


def _lack(llrs: Float32, bits: NDArray[np.uint8] | None) -> int:
    right = llrs if bits is None else np.where(bits == 0, llrs, -llrs)
    size = np.minimum(np.abs(right), np.float32(-LEAST_EXPONENT))
    tail = exponential(-size)
    lack = logarithm(np.float32(1) + tail)
    if bits is None:
        lack += size * tail / (np.float32(1) + tail)
    else:
        lack = np.where(right < 0, size, np.float32(0)) + lack
    return int((lack * _UNITS).astype(np.int32).sum(dtype=np.int64))
