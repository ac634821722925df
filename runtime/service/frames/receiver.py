"""Collects the chunks of one frame pair in a buffer of the right size, taken once, within a budget of memory."""

from __future__ import annotations

import sys
import threading
from typing import Self

import numpy as np

from lightpage.errors import CallerLeft, FrameError, LimitError, OverloadedError
from lightpage.recording.frame_pair import FramePair

Bytes = np.ndarray[tuple[int], np.dtype[np.uint8]]

_RETRY_S = 1.0
_UNSEEN = 2
"""References to spare memory that nobody has a view of: the budget's, and the argument of the count itself."""


class ReceiveBudget:
    """Bytes that all callers together may have sent of pairs that are not yet decoded.

    Only what has come counts: a caller who sends a header and no more takes nothing from the others.

    Args:
        size: bytes.
    """

    def __init__(self, size: int) -> None:
        self._size, self._used, self._taken = size, 0, 0
        self._spare: Bytes | None = None
        self._lock = threading.Lock()

    @property
    def used(self) -> int:
        """Bytes that are taken."""
        with self._lock:
            return self._used

    @property
    def size(self) -> int:
        """Bytes that there are."""
        return self._size

    @property
    def taken(self) -> int:
        """Bytes that were ever taken."""
        with self._lock:
            return self._taken

    def take(self, count: int) -> None:
        """Take bytes.

        Raises:
            OverloadedError: they are not there.
        """
        with self._lock:
            if self._used + count > self._size:
                got, expected = f"{self._used} bytes", f"at most {self._size} with {count} more; try again later"
                raise OverloadedError("frames that are being received", got, expected, retry_s=_RETRY_S)
            self._used += count
            self._taken += count

    def give_back(self, count: int) -> None:
        """Give bytes back."""
        with self._lock:
            self._used -= count

    def memory(self, size: int) -> Bytes:
        """Memory for a pair, uint8 [size]: that of one before, where nobody holds a view of it any more.

        The system would have to fill new memory with zeros first, which takes as long as the pair does.
        """
        with self._lock:
            if self._spare is not None and self._spare.size == size and sys.getrefcount(self._spare) == _UNSEEN:
                spare, self._spare = self._spare, None
                return spare
        return np.empty(size, np.uint8)

    def spare(self, memory: Bytes) -> None:
        """Leave memory of a pair to a later one; one is kept."""
        with self._lock:
            self._spare = memory


class PairReceiver:
    """Takes in-phase pixels, then quadrature pixels, in chunks of any size.

    Args:
        shape: (rows, columns) of a frame.
        dtype: "uint8" or "uint16" (little-endian on the wire).
        max_bytes: most bytes of a pair.
        budget: that it takes its bytes from until it is closed; None for none.

    Raises:
        LimitError: the pair would be larger than `max_bytes`; nothing is allocated then.
    """

    def __init__(self, shape: tuple[int, int], dtype: str, max_bytes: int, budget: ReceiveBudget | None = None) -> None:
        self._shape, self._budget = shape, budget
        self._dtype = np.dtype(dtype).newbyteorder("<")
        self.size = 2 * shape[0] * shape[1] * self._dtype.itemsize
        if self.size > max_bytes:
            raise LimitError("frame pair", f"{self.size} bytes", f"at most {max_bytes}")
        self._lock = threading.Lock()
        """Held while bytes are taken in, so that nobody lets go of them meanwhile."""
        self._buffer: Bytes | None = None
        self._filled, self._closed = 0, False

    @property
    def filled(self) -> int:
        """Bytes that have come."""
        return self._filled

    @property
    def complete(self) -> bool:
        """Whether every pixel has come."""
        return self._filled == self.size

    def add(self, chunk: bytes | memoryview) -> None:
        """Take in the next bytes.

        Raises:
            FrameError: more bytes than the two frames have.
            OverloadedError: more than the budget has.
            CallerLeft: it is closed.
        """
        with self._lock:
            if self._closed:
                raise CallerLeft
            end = self._filled + len(chunk)
            if end > self.size:
                raise FrameError("frame pair", f"at least {end} bytes", f"{self.size} bytes, as the header says")
            if self._budget is not None:
                self._budget.take(len(chunk))
            if self._buffer is None:
                self._buffer = np.empty(self.size, np.uint8) if self._budget is None else self._budget.memory(self.size)
            self._buffer[self._filled : end] = np.frombuffer(chunk, np.uint8)
            self._filled = end

    def checked(self) -> Self:
        """Itself, if every pixel has come.

        Raises:
            FrameError: bytes are missing.
        """
        if not self.complete:
            raise FrameError("frame pair", f"{self._filled} bytes", f"{self.size} bytes, as the header says")
        return self

    def pair(self) -> FramePair:
        """The two frames, views of the one buffer.

        Raises:
            FrameError: bytes are missing.
        """
        self.checked()
        assert self._buffer is not None  # of what is complete
        halves = self._buffer.reshape(2, -1)
        native = self._dtype.newbyteorder("=")
        in_phase, quadrature = (
            half.view(self._dtype).reshape(self._shape).astype(native, copy=False) for half in halves
        )
        return FramePair(in_phase, quadrature)

    def close(self) -> None:
        """Give back what it took from the budget, and take no more."""
        with self._lock:
            self._closed = True
            if self._budget is not None:
                self._budget.give_back(self._filled)
                if self._buffer is not None:
                    self._budget.spare(self._buffer)
            self._filled, self._buffer = 0, None
