"""Limits on work under way: slots, first come, first served; bytes of received frames; decodes that hang."""

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import ceil
from statistics import median

import numpy as np

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import OverloadedError, SlotsTakenError
from lightpage.runtime.service.caller import Caller

MARGIN = 1.1
"""Of the usual time: a call with less time left than this many times it is not begun."""

SLOW = 0.95
"""Nor one with less time left than this share of the last calls took at most."""

REMEMBERED = 20
"""Calls whose time is remembered."""

FORGET_S = 30.0
"""After that a call's time is forgotten: where all are refused, nothing else would show that calls are fast again."""


Bytes = np.ndarray[tuple[int], np.dtype[np.uint8]]

_RETRY_S = 1.0
_UNSEEN = 2
"""References to spare memory that nobody has a view of: its place among the spares, and the argument of the count."""


@dataclass(eq=False)
class _Ticket:
    """A place in the queue."""

    told: threading.Event = field(default_factory=threading.Event)
    has_slot: bool = False


class Slots:
    """A bounded number of slots, for which callers queue.

    Where the usual time of what the slots are for is known, a caller is turned away who could not have it done in
    time: at the end of a long queue before anything is spent on it, and at its head before work begins.

    Args:
        count: slots.
        what: they are for, for the error, e.g. ``"decodes"``.
        deadline_s: longest wait, seconds.
        clock: clock by which callers wait.

    Attributes:
        count: how many there are.
    """

    def __init__(self, count: int, what: str, deadline_s: float, clock: Clock = SYSTEM) -> None:
        self.count, self._what, self._deadline_s, self._clock = count, what, deadline_s, clock
        self._lock = threading.Lock()
        self._free = count
        self._queue: deque[_Ticket] = deque()
        self._lately: deque[tuple[float, float, float]] = deque(maxlen=REMEMBERED)
        """When calls ended, how long they took, and how much longer they would have taken with all steps, seconds."""

    @property
    def queued(self) -> int:
        """Callers that wait."""
        with self._lock:
            return len(self._queue)

    @property
    def busy(self) -> int:
        """Slots that are taken."""
        with self._lock:
            return self.count - self._free

    @property
    def usual_s(self) -> float:
        """Return what a slot was lately held for, the median in seconds; 0 where nothing was done lately."""
        taken = self._taken(whole=False)
        return median(taken) if taken else 0.0

    @property
    def needed_s(self) -> float:
        """Time that the work with all steps hardly ever exceeds; 0 where nothing was done lately."""
        taken = self._taken(whole=True)
        return max(MARGIN * median(taken), taken[ceil(SLOW * len(taken)) - 1]) if taken else 0.0

    def expected_wait_s(self) -> float:
        """Return how long whoever comes now will wait for a slot, seconds."""
        with self._lock:
            ahead = len(self._queue) + (0 if self._free > 0 else 1)
        return self.usual_s * ahead / self.count

    def check(self, caller: Caller, optional_s: float = 0.0) -> None:
        """Turn a caller away for whom it would be too late, before anything is spent on the call.

        Args:
            caller: who waits.
            optional_s: part of the work's time that may be left out for this caller, seconds.

        Raises:
            OverloadedError: the queue is too long, or the caller's deadline shorter than the work takes.
        """
        wait_s, left_s = self.expected_wait_s(), caller.seconds_left()
        needed_s = max(0.0, self.needed_s - optional_s)
        if wait_s + needed_s > left_s:
            raise self._too_late(left_s, wait_s, needed_s, in_queue=wait_s > 0)

    def take(self, caller: Caller, optional_s: float = 0.0) -> None:
        """Take a slot, waiting as long as the caller does, but not for one who has gone.

        Args:
            caller: who waits.
            optional_s: see `check`.

        Raises:
            OverloadedError: too little of the caller's time is left to do the work.
            SlotsTakenError: none until the caller's time is up.
            CallerLeft: the caller has gone.
        """
        caller.check()
        ticket = _Ticket()
        with self._lock:
            if self._free > 0:  # then nobody waits
                self._free -= 1
                ticket.has_slot = True
            else:
                self._queue.append(ticket)
        if queues := not ticket.has_slot:
            self._wait(ticket, caller)
        left_s = caller.seconds_left()
        needed_s = max(0.0, self.needed_s - optional_s)
        if needed_s > left_s:
            self.give_back()
            raise self._too_late(left_s, 0.0, needed_s, in_queue=queues)

    def give_back(self) -> None:
        """Give back a slot that was taken: whoever has waited longest gets it."""
        with self._lock:
            self._free += 1
            self._hand_out()

    def resize(self, count: int) -> None:
        """Have so many slots from now on; where they are fewer, those that are taken are not given to others."""
        with self._lock:
            self._free += count - self.count
            self.count = count
            self._hand_out()

    def _hand_out(self) -> None:
        """Give free slots to those who wait; with the lock held."""
        while self._queue and self._free > 0:
            self._free -= 1
            ticket = self._queue.popleft()
            ticket.has_slot = True
            ticket.told.set()

    @contextmanager
    def held(self, caller: Caller, optional_s: float = 0.0) -> Iterator[None]:
        """Hold a slot in a `with` statement; see `take`."""
        self.take(caller, optional_s)
        try:
            yield
        finally:
            self.give_back()

    @contextmanager
    def held_at_once(self) -> Iterator[None]:
        """Hold a slot without waiting for one.

        Raises:
            SlotsTakenError: there is none.
        """
        with self._lock:
            if self._free <= 0:
                raise SlotsTakenError(self._what, "all taken", f"at most {self.count} at once", retry_s=1.0)
            self._free -= 1
        try:
            yield
        finally:
            self.give_back()

    def took(self, seconds: float, skipped_s: float = 0.0) -> None:
        """Learn from work that was done how long it usually takes.

        Args:
            seconds: time that it took.
            skipped_s: time that steps which were left out would have taken, seconds.
        """
        with self._lock:
            self._lately.append((self._clock.now(), seconds, skipped_s))

    def _taken(self, *, whole: bool) -> list[float]:
        """Return what was lately taken, the shortest first; `whole`: what all steps would have taken."""
        since = self._clock.now() - FORGET_S
        with self._lock:
            return sorted(
                seconds + (skipped if whole else 0.0) for ended, seconds, skipped in self._lately if ended >= since
            )

    def _wait(self, ticket: _Ticket, caller: Caller) -> None:
        with caller.telling(ticket.told.set):
            self._clock.wait(ticket.told, min(caller.seconds_left(), self._deadline_s))
        with self._lock:
            if not ticket.has_slot:
                self._queue.remove(ticket)
        if not caller.is_here:
            if ticket.has_slot:
                self.give_back()
            caller.check()
        if not ticket.has_slot:
            expected = "a free one within the deadline; try again later"
            raise SlotsTakenError(f"concurrent {self._what}", "all taken", expected, retry_s=self.expected_wait_s())

    def _too_late(self, left_s: float, wait_s: float, work_s: float, *, in_queue: bool) -> OverloadedError:
        """The error of a caller who comes too late; without a queue, coming again with that deadline is of no use."""
        needed_s, left_s = wait_s + work_s, max(0.0, left_s)
        subject, told = f"concurrent {self._what}", f"{left_s:.2f} s until the deadline"
        if not in_queue:
            return OverloadedError(subject, told, f"at least {needed_s:.2f} s")
        expected = f"at least {needed_s:.2f} s, {wait_s:.2f} s of it in the queue; try again later"
        return OverloadedError(subject, told, expected, max(self.usual_s / self.count, needed_s - left_s))


class Heart:
    """Knows of every decode that runs.

    Args:
        longest_s: a decode that takes longer has hung.
        clock: seconds that never go back.
    """

    def __init__(self, longest_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._longest_s, self._clock = longest_s, clock
        self._lock = threading.Lock()
        self._begun: dict[tuple[int, object], float] = {}
        """When decodes began, by their threads."""

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """A decode runs within the `with` statement."""
        key = threading.get_ident(), object()
        with self._lock:
            self._begun[key] = self._clock()
        try:
            yield
        finally:
            with self._lock:
                del self._begun[key]

    def waits(self) -> None:
        """Begin anew to count the time of this thread's decodes, which wait for others."""
        thread, now = threading.get_ident(), self._clock()
        with self._lock:
            self._begun.update((key, now) for key in self._begun if key[0] == thread)

    def trouble(self) -> str:
        """Why the service cannot be said to serve; empty where it can."""
        with self._lock:
            oldest = min(self._begun.values(), default=None)
        taken_s = 0.0 if oldest is None else self._clock() - oldest
        return f"a decode has been running for {taken_s:.0f} s" if taken_s > self._longest_s else ""


class ReceiveBudget:
    """Bytes that all callers together may have sent of pairs that are not yet decoded.

    Only what has come counts: a caller who sends a header and no more takes nothing from the others.

    Args:
        size: bytes.
        spares: pairs whose memory is kept for later ones.

    Attributes:
        size: bytes that there are.
        used: bytes that are taken.
        taken: bytes that were ever taken.
    """

    def __init__(self, size: int, spares: int = 1) -> None:
        self.size, self.used, self.taken = size, 0, 0
        self._spares: deque[Bytes] = deque(maxlen=spares)
        self._lock = threading.Lock()

    def take(self, count: int) -> None:
        """Take bytes.

        Raises:
            OverloadedError: they are not there.
        """
        with self._lock:
            if self.used + count > self.size:
                got, expected = f"{self.used} bytes", f"at most {self.size} with {count} more; try again later"
                raise OverloadedError("frames that are being received", got, expected, retry_s=_RETRY_S)
            self.used += count
            self.taken += count

    def give_back(self, count: int) -> None:
        """Give bytes back."""
        with self._lock:
            self.used -= count

    def memory(self, size: int) -> Bytes:
        """Memory for a pair, uint8 [size]: that of one before, where nobody holds a view of it any more.

        The system would have to fill new memory with zeros first, which takes as long as the pair does.
        """
        with self._lock:
            for _ in range(len(self._spares)):
                if self._spares[0].size == size and sys.getrefcount(self._spares[0]) == _UNSEEN:
                    return self._spares.popleft()
                self._spares.rotate(-1)
        return np.empty(size, np.uint8)

    def keep(self, spares: int) -> None:
        """Have memory of so many pairs kept from now on, see the constructor."""
        with self._lock:
            self._spares = deque(self._spares, maxlen=spares)

    def spare(self, memory: Bytes) -> None:
        """Leave memory of a pair to a later one; the last ones are kept."""
        with self._lock:
            self._spares.append(memory)
