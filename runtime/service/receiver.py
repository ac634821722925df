"""Collects the chunks of one frame pair in a buffer of the right size, allocated once."""

from __future__ import annotations

import numpy as np

from lightpage.errors import FrameError, LimitError
from lightpage.recording.reader import FramePair


class PairReceiver:
    """Takes in-phase pixels, then quadrature pixels, in chunks of any size.

    Args:
        shape: (rows, columns) of a frame.
        dtype: "uint8" or "uint16" (little-endian on the wire).
        max_bytes: most bytes of a pair.

    Raises:
        LimitError: the pair would be larger than `max_bytes`; nothing is allocated then.
    """

    def __init__(self, shape: tuple[int, int], dtype: str, max_bytes: int) -> None:
        self._shape = shape
        self._dtype = np.dtype(dtype).newbyteorder("<")
        self._frame_bytes = shape[0] * shape[1] * self._dtype.itemsize
        if 2 * self._frame_bytes > max_bytes:
            raise LimitError("frame pair", f"{2 * self._frame_bytes} bytes", f"at most {max_bytes}")
        self._buffer = np.empty(2 * self._frame_bytes, np.uint8)
        self._filled = 0

    @property
    def complete(self) -> bool:
        """Whether every pixel has come."""
        return self._filled == self._buffer.size

    def add(self, chunk: bytes) -> None:
        """Take in the next bytes.

        Raises:
            FrameError: more bytes than the two frames have.
        """
        end = self._filled + len(chunk)
        if end > self._buffer.size:
            raise FrameError("frame pair", f"at least {end} bytes", f"{self._buffer.size} bytes, as the header says")
        self._buffer[self._filled : end] = np.frombuffer(chunk, np.uint8)
        self._filled = end

    def pair(self) -> FramePair:
        """The two frames, views of the one buffer.

        Raises:
            FrameError: bytes are missing.
        """
        if not self.complete:
            raise FrameError("frame pair", f"{self._filled} bytes", f"{self._buffer.size} bytes, as the header says")
        halves = self._buffer.reshape(2, -1)
        native = self._dtype.newbyteorder("=")
        in_phase, quadrature = (
            half.view(self._dtype).reshape(self._shape).astype(native, copy=False) for half in halves
        )
        return FramePair(in_phase, quadrature)
