"""Takes values in another order and puts them back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.compiled.choice import compiled


def gathered(values: NDArray[np.float32], order: NDArray[np.int32]) -> NDArray[np.float32]:
    """`values[order]` of contiguous arrays."""
    native = compiled()
    if native is None:
        return values[order]
    out = np.empty(len(order), np.float32)
    native.gather(values, order, out)
    return out


def scatter(bits: NDArray[np.uint8], order: NDArray[np.int32], out: NDArray[np.uint8]) -> None:
    """Do `out[order] = bits` with contiguous arrays."""
    native = compiled()
    if native is None:
        out[order] = bits
    else:
        native.scatter(bits, order, out)
