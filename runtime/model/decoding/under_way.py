"""Pages that are under way to a batch or behind one, and what the device that computes batches does meanwhile."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from enum import StrEnum


class Phase(StrEnum):
    """A stretch of a page's way."""

    COMING = "coming"
    """Its frames are being checked."""
    WAITING = "waiting"
    """It waits for its batch to be run."""
    RUNNING = "running"
    """Its batch runs."""
    BEHIND = "behind"
    """It is post-processed."""


class Device(StrEnum):
    """State of the device, by the pages that are under way; it is in one of these at every moment."""

    RUNNING = "running"
    """It computes a batch."""
    FRAMES = "frames"
    """It waits until the frames of a batch are there."""
    POST_PROCESSING = "post_processing"
    """It waits for pages behind it, whose callers send no others meanwhile."""
    IDLE = "idle"
    """There is nothing to do."""


class UnderWay:
    """Pages under way by the threads that see to them, and how long the device did what. For many threads.

    Args:
        clock: seconds that never go back.

    Attributes:
        runs: how many batches there were of each number of pages.
        alone: pages that were not computed together though that was wanted.
        gone: models that gathered pages, and are no more: the memory of their graphs is free.
        waits: is called again and again by each thread that waits for others' batches.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._since = clock, clock()
        self._lock = threading.Lock()
        self._phases: dict[int, Phase] = {}
        self._spent = dict.fromkeys(Device, 0.0)
        self.runs: Counter[int] = Counter()
        self.alone = self.gone = 0
        self.waits: Callable[[], None] = lambda: None

    def move(self, phase: Phase | None, *threads: int) -> None:
        """Have the pages of some threads in another phase; None ends their way."""
        with self._lock:
            self._count()
            for thread in threads:
                if phase is None:
                    self._phases.pop(thread, None)
                else:
                    self._phases[thread] = phase

    def count(self, phase: Phase) -> int:
        """The number of pages in a phase."""
        with self._lock:
            return list(self._phases.values()).count(phase)

    def knows(self, thread: int) -> bool:
        """Return whether a thread sees to a page."""
        with self._lock:
            return thread in self._phases

    def ran(self, pages: int) -> None:
        """Count a batch that was run."""
        with self._lock:
            self.runs[pages] += 1

    def went_alone(self) -> None:
        """Count a page that is not computed together."""
        with self._lock:
            self.alone += 1

    def let_go(self) -> None:
        """Count a model that is gone."""
        with self._lock:
            self.gone += 1

    def seconds(self) -> dict[Device, float]:
        """Seconds that the device spent in each state until now."""
        with self._lock:
            self._count()
            return dict(self._spent)

    def _count(self) -> None:
        now = self._clock()
        self._spent[_device(self._phases.values())] += now - self._since
        self._since = now


def _device(pages: Iterable[Phase]) -> Device:
    there = set(pages)
    if Phase.RUNNING in there:
        return Device.RUNNING
    if there & {Phase.COMING, Phase.WAITING}:
        return Device.FRAMES
    return Device.POST_PROCESSING if there else Device.IDLE
