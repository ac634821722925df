"""Pixels as cameras send them: the inverse of `lightpage.runtime.device.cameras.pixel_formats.unpack`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError
from lightpage.recording.layout import frame_type
from lightpage.runtime.device.cameras.pixel_formats import pixel_format


def pack(counts: NDArray[np.unsignedinteger[Any]], name: str) -> NDArray[np.uint8]:
    """Counts as a camera sends them, bytes [n].

    Args:
        counts: [row, column], of the format's bit depth.
        name: name of the pixel format.

    Raises:
        InvalidInputError: see `pixel_format`.
        FrameError: a count that has more bits.
    """
    known = pixel_format(name)
    if counts.dtype.kind != "u" or int(counts.max(initial=0)) >> known.bit_depth:
        raise FrameError(f"frame in {name}", f"{counts.dtype} up to {counts.max(initial=0)}", f"{known.bit_depth} bits")
    if known.spread is None:
        stored = np.ascontiguousarray(counts, frame_type(known.bit_depth).newbyteorder("<"))
        return np.frombuffer(stored.tobytes(), np.uint8)
    four = np.zeros((-(-counts.size // 4), 4), np.uint64)
    four.reshape(-1)[: counts.size] = counts.reshape(-1)
    if name.endswith("p"):
        placed = four << np.arange(4, dtype=np.uint64) * np.uint64(known.bit_depth)
    else:  # two pixels in three bytes, the low bits of both in the middle one
        low_bits = np.uint64(known.bit_depth - 8)
        placed = four >> low_bits << np.array([0, 16, 24, 40], np.uint64)
        placed |= (four & (np.uint64(1) << low_bits) - np.uint64(1)) << np.array([8, 12, 32, 36], np.uint64)
    words: NDArray[np.uint8] = np.bitwise_or.reduce(placed, axis=1).astype("<u8").view(np.uint8).reshape(-1, 8)
    return words[:, : known.group_bytes].reshape(-1)[: known.nbytes(counts.size)]
