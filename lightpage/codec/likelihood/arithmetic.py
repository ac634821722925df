"""Exponentials and logarithms in float32 by operations that every processor rounds alike.

numpy's own differ from machine to machine in the last bit. These are the polynomials of Cephes (S. Moshier), each
operation rounded by itself; `page_code.c` does the same ones in the same order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

LEAST_EXPONENT = -80.0
"""Least argument of `exponential`: less is far below what LLRs can tell, and would end in denormal numbers."""
_HIGH, _LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
"""ln 2 in two parts: a whole number of at most 7 bits times the first is exact."""
_EXPONENTIAL = [
    np.float32(c)
    for c in (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1)
]
_LOGARITHM = [
    np.float32(c)
    for c in (
        7.0376836292e-2,
        -1.1514610310e-1,
        1.1676998740e-1,
        -1.2420140846e-1,
        1.4249322787e-1,
        -1.6668057665e-1,
        2.0000714765e-1,
        -2.4999993993e-1,
        3.3333331174e-1,
    )
]
_ROUNDING = np.float32(1.5 * 2**23)
"""A sum with it is rounded to a whole number, which stands in its lowest bits."""
_SQUARE_ROOT_OF_HALF = np.uint32(0x3F3504F3)


def exponential(x: Float32) -> Float32:
    """e^x of float32 from `LEAST_EXPONENT` to 0; same shape."""
    turn = x * np.float32(1.44269504088896341)
    turn += _ROUNDING
    n = turn - _ROUNDING
    r = x - n * _HIGH
    r -= n * _LOW
    p = r * _EXPONENTIAL[0]
    for c in _EXPONENTIAL[1:]:
        p += c
        if c is not _EXPONENTIAL[-1]:
            p *= r
    p *= r * r
    p += r
    p += np.float32(1)
    scale = turn.view(np.uint32)
    scale += np.uint32(127)
    scale <<= np.uint32(23)
    p *= scale.view(np.float32)
    return p


def logarithm(x: Float32) -> Float32:
    """Natural logarithm of positive float32 that are not denormal; same shape."""
    bits = x.view(np.uint32)
    exponent = (bits - _SQUARE_ROOT_OF_HALF) & np.uint32(0xFF800000)
    n = exponent.view(np.int32).astype(np.float32)
    n *= np.float32(2.0**-23)
    r = (bits - exponent).view(np.float32) - np.float32(1)
    square = r * r
    p = r * _LOGARITHM[0]
    for c in _LOGARITHM[1:-1]:
        p += c
        p *= r
    p += _LOGARITHM[-1]
    p *= r * square
    p += n * _LOW
    p -= np.float32(0.5) * square
    p += r
    p += n * _HIGH
    return p
