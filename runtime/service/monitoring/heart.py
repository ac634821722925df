"""Whether the service still does its work: decodes that run for too long have hung."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Heart:
    """Knows of every decode that runs.

    Args:
        longest_s: a decode that takes longer has hung.
        clock: seconds that never go back.
    """

    def __init__(self, longest_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._longest_s, self._clock = longest_s, clock
        self._lock = threading.Lock()
        self._begun: dict[object, float] = {}

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """A decode runs within the `with` statement."""
        key = object()
        with self._lock:
            self._begun[key] = self._clock()
        try:
            yield
        finally:
            with self._lock:
                del self._begun[key]

    def trouble(self) -> str:
        """Why the service cannot be said to serve; empty where it can."""
        with self._lock:
            oldest = min(self._begun.values(), default=None)
        taken_s = 0.0 if oldest is None else self._clock() - oldest
        return f"a decode has been running for {taken_s:.0f} s" if taken_s > self._longest_s else ""
