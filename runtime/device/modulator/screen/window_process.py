"""The service's end of the process that has a modulator's window."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.helper_process import HelperProcess
from lightpage.runtime.device.modulator.screen.screen_link import REQUEST, Answer
from lightpage.runtime.device.modulator.settings import ScreenSettings


class WindowProcess:
    """A process with a window in it; it ends with this one. Moments are `time.monotonic` seconds.

    Args:
        settings: of the modulator.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, settings: ScreenSettings) -> None:
        self._number = 0
        self._opening: Answer | None = None
        self._process = HelperProcess(
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
        self._process.send(request if image is None else request + image.tobytes(), deadline)
        return self._answer(self._number, deadline)

    def ended(self) -> bool:
        """Whether it runs no more."""
        return self._process.ended()

    def end(self) -> None:
        """End it, and with it the window."""
        self._process.end()

    def _answer(self, number: int, deadline: float) -> Answer:
        answer = Answer.from_line(self._process.line(deadline))
        if answer.number != number:
            raise ConnectionError(f"its window answers request {answer.number} for {number}")
        return answer
