"""How many may do a thing at once."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from runtime.errors import SlotsTakenError
from runtime.service.caller import Caller

_POLL_S = 0.5
"""Seconds from one look at whether a caller who waits is still there to the next."""


class Slots:
    """A bounded number of slots, for each of which callers wait as long as they may.

    Args:
        count: slots.
        what: they are for, for the error, e.g. ``"decodes"``.
        deadline_s: longest wait, seconds.
    """

    def __init__(self, count: int, what: str, deadline_s: float) -> None:
        self._free, self._what, self._deadline_s = threading.BoundedSemaphore(count), what, deadline_s

    def take(self, caller: Caller) -> None:
        """Take a slot, waiting as long as the caller does, but not for one who has gone.

        Raises:
            SlotsTakenError: none until the caller's time is up.
            CallerLeft: the caller has gone.
        """
        until = time.monotonic() + min(caller.seconds_left(), self._deadline_s)
        while not self._free.acquire(timeout=min(_POLL_S, max(0.0, until - time.monotonic()))):
            caller.check()
            if time.monotonic() >= until:
                expected = "a free one within the deadline; try again later"
                raise SlotsTakenError(f"concurrent {self._what}", "all taken", expected)

    def give_back(self) -> None:
        """Give back a slot that was taken."""
        self._free.release()

    @contextmanager
    def held(self, caller: Caller) -> Iterator[None]:
        """Hold a slot in a `with` statement; raises as `take`."""
        self.take(caller)
        try:
            yield
        finally:
            self.give_back()
