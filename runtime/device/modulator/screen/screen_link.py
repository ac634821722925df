"""What a screen modulator and the process of its window say to each other, over a socket."""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, dataclass
from typing import Self

REQUEST = struct.Struct("!?I")
"""Whether a page follows (one byte per pixel of the modulator, row by row), and the request's number, from 1."""


@dataclass(frozen=True)
class Answer:
    """A line of JSON from the window's process.

    Attributes:
        number: that of the request; 0 for the word that the window is open, or cannot be opened.
        shows: whether the whole last page is on display, as far as the X server knows.
        got: why the window cannot be opened, else empty.
        expected: what would have been right.
    """

    number: int
    shows: bool = False
    got: str = ""
    expected: str = ""

    def to_line(self) -> bytes:
        """As it is sent, the line's end included."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def from_line(cls, line: bytes) -> Self:
        """Read what `to_line` wrote."""
        return cls(**json.loads(line))
