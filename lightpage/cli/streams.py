"""Standard streams that may be closed, full or absent: what is written to them is lost then, and nothing else."""

from __future__ import annotations

import errno
import os
import sys
from contextlib import suppress
from typing import Any, TextIO


class LastingStream:
    """A text stream whose failure loses what is written to it, and stops nothing.

    Args:
        stream: stream of the process.

    Attributes:
        failure: why something was lost; None where nothing was, or where the reader had seen enough.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        """Write `text`, or lose it; its length comes back."""
        try:
            self._stream.write(text)
        except OSError as error:
            self._give_up(error)
        return len(text)

    def flush(self) -> None:
        """Hand over what is written, or lose it."""
        try:
            self._stream.flush()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        """Write to nowhere from now on: the interpreter flushes once more at its end."""
        if error.errno != errno.EPIPE:
            self.failure = self.failure or error
        with suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def take_streams() -> tuple[LastingStream, LastingStream]:
    """Have stdout and stderr outlast their failure; they come back in this order.

    Descriptors that the process was started without are opened to nowhere, or a file that is opened later would have
    their numbers, and messages of libraries would be written into it. What an encoding cannot say is escaped.
    """
    missing = []
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            missing.append(os.open(os.devnull, os.O_RDWR))  # the lowest number that is free
    if sys.stdin is None:
        sys.stdin = os.fdopen(0, closefd=False)
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        stream = getattr(sys, name)
        if stream is None or descriptor in missing:
            stream = os.fdopen(descriptor, "w", closefd=False)
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
        setattr(sys, name, LastingStream(stream))
    return sys.stdout, sys.stderr  # type: ignore[return-value]
