"""Stages of a page's way: exactly one runs at every moment, so that their times add up to the whole."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum


class Stage(StrEnum):
    """A part of a page's way through the service."""

    RECEIVE = "receive"
    """Its frames come: from the caller, whose wait to send them counts, black level taken off; or from cameras."""
    QUEUE = "queue"
    """It waits: for a slot, for that of a range, for its batch, for pages before it, for its request elsewhere."""
    INFERENCE = "inference"
    """Its frames are checked, and the graph runs, every attempt counted."""
    POST_PROCESSING = "post_processing"
    """What is left of the decode: piston, tracking, a search, the decision; and those are told who watch the device."""
    CODE = "code"
    """Its user bytes are read."""
    RESPOND = "respond"
    """Its reply is built, serialised, and handed to gRPC."""


@dataclass(frozen=True)
class Lap:
    """A stretch of one stage: its start and its end, seconds of the clock."""

    stage: Stage
    start: float
    end: float

    @property
    def seconds(self) -> float:
        """Return how long it was."""
        return self.end - self.start


class Stages:
    """Times one page. The first stage counts from `start`; an ended one changes no more.

    Its methods may be called from many threads: a call may end while its page is still computed.

    Args:
        start: when the page's way began, seconds of `clock`; now if None.
        clock: seconds that never go back.

    Attributes:
        laps: the stages that have ended, in their order.
        is_dropped: whether there was no such page, so that nothing is to be told of it.
    """

    def __init__(self, start: float | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.start = self._since = clock() if start is None else start
        self._lock = threading.Lock()
        self.laps: list[Lap] = []
        self.is_dropped = False
        self._running: Stage | None = None
        self._end: float | None = None

    def begin(self, stage: Stage, after_s: float | None = None) -> None:
        """Begin a stage; the one that runs ends.

        Args:
            stage: which.
            after_s: when it began, seconds after the one that runs did, at most now; now if None.
        """
        with self._lock:
            if self._end is not None:
                return
            now = self._clock()
            if self._running is not None:
                now = now if after_s is None else min(now, self._since + after_s)
                self._close(now)
            self._running = stage

    def end(self, at: float | None = None) -> float:
        """The page's way has ended, seconds of the clock; now if None. Returns when it first did."""
        with self._lock:
            if self._end is None:
                self._end = max(self._since, self._clock() if at is None else at)
                if self._running is not None:
                    self._close(self._end)
            return self._end

    @property
    def elapsed_s(self) -> float:
        """Return the seconds from its start to its end, or to now."""
        return (self._clock() if self._end is None else self._end) - self.start

    def seconds(self) -> dict[Stage, float]:
        """Return how long each stage took until now, those left out that never ran."""
        with self._lock:
            laps = list(self.laps)
            if self._end is None and self._running is not None:
                laps.append(Lap(self._running, self._since, self._clock()))
        taken: dict[Stage, float] = {}
        for lap in laps:
            taken[lap.stage] = taken.get(lap.stage, 0.0) + lap.seconds
        return taken

    def _close(self, now: float) -> None:
        """End the running stage; a stage that goes on is one lap."""
        assert self._running is not None  # of whoever calls
        lap = Lap(self._running, self._since, now)
        if self.laps and self.laps[-1].stage is lap.stage:
            lap = Lap(lap.stage, self.laps.pop().start, now)
        self.laps.append(lap)
        self._since = now


class CallTimes:
    """Times the pages of one call.

    Args:
        begun: when the call began, `time.perf_counter` seconds.
        observe: is told of each page that has ended.
        keep: pages that are remembered, the first ones.

    Attributes:
        count: pages that were begun.
        pages: those that are remembered.
    """

    def __init__(
        self, begun: float | None = None, observe: Callable[[Stages], None] = lambda _: None, keep: int = 0
    ) -> None:
        self._next = time.perf_counter() if begun is None else begun
        self._observe, self._keep = observe, keep
        self._lock = threading.Lock()
        self._open: list[Stages] = []
        self.pages: list[Stages] = []
        self.count = 0

    def page(self, start: float | None = None) -> Stages:
        """Begin to time a page: from `start`, or from where the page before it ended, the first from the call's own."""
        stages = Stages(self._next if start is None else start)
        with self._lock:
            self._open.append(stages)
            self.count += 1
        return stages

    def done(self, stages: Stages, at: float | None = None) -> None:
        """A page has ended, `time.perf_counter` seconds; now if None."""
        ended = stages.end(at)
        with self._lock:
            if stages not in self._open:
                return
            self._open.remove(stages)
            if stages.is_dropped:
                self.count -= 1
                return
            if len(self.pages) < self._keep:
                self.pages.append(stages)
            self._next = ended
        self._observe(stages)

    def end(self, at: float | None = None) -> None:
        """The call has ended, and whatever page was on its way; see `done`."""
        with self._lock:
            still = list(self._open)
        for stages in still:
            self.done(stages, at)
