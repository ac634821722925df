"""The service's end of the process that has a modulator's window, and what the two say to each other over a socket."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from lightpage.helper_process import HelperProcess
from lightpage.runtime.device.modulator.screen.raster import ScreenSettings

REQUEST = struct.Struct("!?I")
"""Whether a page follows (one byte per pixel of the modulator, row by row), and the request's number, from 1."""


class Answer(BaseModel):
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
        return self.model_dump_json().encode() + b"\n"


class WindowProcess(HelperProcess):
    """A process with a window in it; it ends with this one. Moments are `time.monotonic` seconds.

    Args:
        settings: of the modulator.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, settings: ScreenSettings) -> None:
        self._number = 0
        self._opening: Answer | None = None
        super().__init__(
            "lightpage.runtime.device.modulator.screen.screen_window",
            # of a table that wires a device, what else it says is not the window's
            settings.model_dump_json(include=set(ScreenSettings.model_fields)),
            subject="the process of its window",
        )

    def opening(self, deadline: float) -> Answer:
        """Its word that the window is open, or why it cannot be.

        Raises:
            TimeoutError: it has not said so by then, and may yet.
            ConnectionError: it has ended.
        """
        if self._opening is None:
            self._opening = self._answer(0, deadline)
        return self._opening

    def ask(self, deadline: float, image: NDArray[np.uint8] | None = None) -> Answer:
        """Have it show a picture, or only say whether it shows the last one.

        Raises:
            TimeoutError: it has not answered by then; it is of no more use.
            ConnectionError: it has ended.
        """
        self._number += 1
        request = REQUEST.pack(image is not None, self._number)
        self.send(request if image is None else request + image.tobytes(), deadline)
        return self._answer(self._number, deadline)

    def _answer(self, number: int, deadline: float) -> Answer:
        answer = Answer.model_validate_json(self.line(deadline))
        if answer.number != number:
            raise ConnectionError(f"its window answers request {answer.number} for {number}")
        return answer
