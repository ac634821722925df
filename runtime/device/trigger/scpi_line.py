"""The one owner of a serial line to an SCPI device: a thread does all input and output, callers wait with a deadline.

A caller that gives up takes nothing with it: the answer that may still come belongs to its message alone.
"""

import queue
import re
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, TypeVar

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import LostShotError, Reason
from lightpage.runtime.device.trigger.scpi_port import LineTimes, ScpiPort

T = TypeVar("T")

_DONE = re.compile("ok", re.IGNORECASE)
_STOP_S = 2.0
"""Longest wait for the port at `close`."""
_GRACE_S = 0.5
"""A caller waits so much longer than the thread, whose error says more."""


class ScpiLine:
    """Messages to an SCPI device, one after another. Its methods may be called from many threads.

    The line is opened by the first message, and again after it was unplugged: by the same name, which may be a link
    that has come to point to another port (``/dev/serial/by-id/...``).

    Args:
        port: device path, e.g. ``/dev/ttyUSB0``, or pyserial URL, e.g. ``socket://127.0.0.1:2101``.
        baud: bits per second of a serial port.
        times: how long is waited.
        clock: clock by which it is waited.
    """

    def __init__(self, port: str, baud: int = 115200, times: LineTimes | None = None, clock: Clock = SYSTEM) -> None:
        self._times = times or LineTimes()
        self._clock = clock
        self._port = ScpiPort(port, baud, self._times, clock)
        self.name = self._port.name
        self._requests: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        """Guards the thread's start and end."""
        self._thread: threading.Thread | None = None

    @property
    def session(self) -> int:
        """Grows when the line is opened or synchronised; 0 before. In between, every message has been answered."""
        return self._port.session

    def send(self, command: str, session: int | None = None) -> float:
        """Send a command, wait for its ``ok``, return the middle of its sending by the clock.

        Args:
            command: a line of ASCII without its end.
            session: send it only if the line was not interrupted since this session; None connects where needed.

        Raises:
            LostShotError: `Reason.TRIGGER_GONE`: no ``ok``, and it may or may not have been done;
                `Reason.TRIGGER_REFUSED`: the device answers that it cannot.
            SourceError: the port's name or the baud rate makes no sense.
        """
        return self._wait(self._port.ask, command, _DONE, session)[1]

    def query(self, question: str, answer: re.Pattern[str], session: int | None = None) -> str:
        """Ask and return the answer. It is asked twice, so that an answer that the line altered is seen.

        Args:
            question: without line end.
            answer: what an answer looks like, all of it; anything else is none.
            session: see `send`.

        Raises:
            LostShotError, SourceError: see `send`.
        """
        return self._wait(self._port.ask_twice, question, answer, session)

    def close(self) -> None:
        """Let go of the line and end the thread; the next message opens it again."""
        with self._lock:
            if self._thread is not None:
                self._requests.put(None)
                self._thread.join(_STOP_S)
                if not self._thread.is_alive():
                    self._thread = None

    def _wait(
        self,
        ask: Callable[[str, re.Pattern[str], int | None, float], T],
        message: str,
        answer: re.Pattern[str],
        session: int | None,
    ) -> T:
        timeout_s = self._times.longest_s
        result: Future[T] = Future()
        with self._lock:
            if self._thread is None or not self._thread.is_alive():
                # A port that hangs must not keep the process from ending.
                self._thread = threading.Thread(target=self._own, name=self.name, daemon=True)
                self._thread.start()
            self._requests.put((result, partial(ask, message, answer, session, self._clock.now() + timeout_s)))
        answered = threading.Event()
        result.add_done_callback(lambda _: answered.set())
        if not self._clock.wait(answered, timeout_s + _GRACE_S):
            result.cancel()
            told = f"{message} not answered within {timeout_s:g} s"
            raise LostShotError(self.name, told, "an answer", Reason.TRIGGER_GONE)
        return result.result()

    def _own(self) -> None:
        """Serve callers until told to stop; only this thread touches the port."""
        while (request := self._requests.get()) is not None:
            result, ask = request
            if result.set_running_or_notify_cancel():
                try:
                    result.set_result(ask())
                except BaseException as error:  # whatever it is, it is the caller's
                    result.set_exception(error)
        self._port.close()
