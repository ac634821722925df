"""A clock that tests move."""

import threading
import time
from collections.abc import Callable

from lightpage.clock import Clock

_BOUND_S = 30.0
_LOOK_S = 0.005


class HandClock(Clock):
    """A clock that stands still until somebody moves it; who sleeps by it moves it, and does not wait.

    A thread that waits by it goes on when what it waits for is there, or when another thread has moved the clock far
    enough; if neither happens within 30 real seconds, the wait raises `TimeoutError`.
    """

    def __init__(self, start: float = 1000.0) -> None:
        self._now = start
        self._lock = threading.Lock()
        self._waiting = 0

    def now(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self.advance(max(0.0, seconds))

    def advance(self, seconds: float) -> None:
        with self._lock:
            self._now += seconds

    def wait(self, event: threading.Event, seconds: float) -> bool:
        return self._until(event.is_set, seconds, event.wait)

    def wait_for(self, changed: threading.Condition, holds: Callable[[], bool], seconds: float) -> bool:
        return self._until(holds, seconds, changed.wait)

    def _until(self, holds: Callable[[], bool], seconds: float, look: Callable[[float], object]) -> bool:
        end, bound = self._now + seconds, time.monotonic() + _BOUND_S
        with self._lock:
            self._waiting += 1
        try:
            while not holds():
                if self._now >= end:
                    return False
                if time.monotonic() >= bound:
                    raise TimeoutError(f"nobody moved the clock, nor did what was waited for come, within {_BOUND_S} s")
                look(_LOOK_S)
            return True
        finally:
            with self._lock:
                self._waiting -= 1

    def until_somebody_waits(self, count: int = 1) -> None:
        """Return once that many threads wait by the clock; raise `TimeoutError` if they don't within 30 s."""
        bound = time.monotonic() + _BOUND_S
        while self._waiting < count:
            if time.monotonic() >= bound:
                raise TimeoutError(f"{self._waiting} threads wait by the clock, wanted {count}")
            time.sleep(_LOOK_S)
