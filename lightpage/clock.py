"""The clock by which code waits: the system's, in whose place a test gives one that it moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Clock:
    """The system's monotonic clock.

    A class that waits takes a `Clock`; one that only reads the time takes `clock: Callable[[], float]`.
    """

    def now(self) -> float:
        """Return the time, `time.monotonic` seconds."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Return after that many seconds; at once if they are zero or fewer."""
        if seconds > 0:
            time.sleep(seconds)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait at most that many seconds for an event, and return whether it is set."""
        return event.wait(max(0.0, seconds))

    def wait_for(self, changed: threading.Condition, holds: Callable[[], bool], seconds: float) -> bool:
        """Wait at most that many seconds until `holds()`, and return what it says last.

        Args:
            changed: a condition that the caller holds, and that is notified when the answer may have changed.
        """
        return changed.wait_for(holds, max(0.0, seconds))


SYSTEM = Clock()
"""Default of every class and function that takes a clock."""
