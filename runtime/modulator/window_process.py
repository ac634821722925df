"""The service's end of the process that has a modulator's window."""

from __future__ import annotations

import socket
import subprocess
import sys
import time

import numpy as np
from numpy.typing import NDArray

from runtime.modulator.screen_link import REQUEST, Answer
from runtime.modulator.settings import ScreenSettings


class WindowProcess:
    """A process with a window in it; it ends with this one. Moments are `time.monotonic` seconds.

    Args:
        settings: of the modulator.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, settings: ScreenSettings) -> None:
        self._link, other = socket.socketpair()
        self._received = b""
        self._number = 0
        self._opening: Answer | None = None
        command = [sys.executable, "-m", "runtime.modulator.screen_window", settings.model_dump_json()]
        with other:
            try:
                # In a session of its own: Ctrl-C is for the service, which then ends the window.
                self._process = subprocess.Popen(
                    command, stdin=other.fileno(), stdout=subprocess.DEVNULL, start_new_session=True
                )
            except OSError:
                self._link.close()
                raise

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
        self._link.settimeout(_left(deadline))
        self._link.sendall(request if image is None else request + image.tobytes())
        return self._answer(self._number, deadline)

    def ended(self) -> bool:
        """Whether it runs no more."""
        return self._process.poll() is not None

    def end(self) -> None:
        """End it, and with it the window."""
        self._link.close()
        self._process.kill()
        self._process.wait()

    def _answer(self, number: int, deadline: float) -> Answer:
        while b"\n" not in self._received:
            self._link.settimeout(_left(deadline))
            if not (more := self._link.recv(65536)):
                raise ConnectionError("the process of its window has ended")
            self._received += more
        line, _, self._received = self._received.partition(b"\n")
        answer = Answer.from_line(line)
        if answer.number != number:
            raise ConnectionError(f"its window answers request {answer.number} for {number}")
        return answer


def _left(deadline: float) -> float:
    """Seconds until then.

    Raises:
        TimeoutError: it has passed.
    """
    if (left := deadline - time.monotonic()) <= 0:
        raise TimeoutError
    return left
