"""Health of the store, for health checks and metrics: a disk that hangs must not silence the rest."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from lightpage.clock import SYSTEM, Clock

LONGEST_S = 5.0
"""A look at the store that takes longer has hung."""


class Reason(StrEnum):
    """Faults of a store."""

    NOTE = "note"
    """Its database is damaged or gone, so that it is not known what was in service."""
    BUNDLE = "bundle"
    """The bundle that was in service is damaged or gone."""
    FULL = "full"
    READ_ONLY = "read_only"
    GONE = "gone"
    HUNG = "hung"
    """The disk does not answer."""
    FAILED = "failed"
    """The disk fails in another way."""


@dataclass(frozen=True)
class Trouble:
    """A fault of a store, and the same in words."""

    reason: Reason
    text: str


class StoreHealth:
    """Looks at the store in a thread of its own, which does not hold the end of the process; many threads may ask.

    Args:
        trouble: says what is wrong with the store, nothing where it is well.
        longest_s: a look that takes longer has hung.
        clock: clock by which a look is timed and waited for.
    """

    def __init__(self, trouble: Callable[[], object], longest_s: float = LONGEST_S, clock: Clock = SYSTEM) -> None:
        self._trouble, self._longest_s, self._clock = trouble, longest_s, clock
        self._beginning = threading.Lock()
        """Held while a look begins, so that there is one at a time."""
        self._ended = threading.Event()
        """Of the present look; set while there is none."""
        self._ended.set()
        self._begun = 0.0
        self._is_well = True

    def is_well(self, wait_s: float = 0.0) -> bool:
        """Return the finding of the last look that ended; begin the next one, and wait at most `wait_s` for its end."""
        with self._beginning:
            if self._ended.is_set():
                self._begun, ended = self._clock.now(), threading.Event()
                threading.Thread(target=self._look, args=[ended], name="lightpage-store-look", daemon=True).start()
                self._ended = ended
            ended = self._ended
        if wait_s > 0 and not self.hangs:
            self._clock.wait(ended, wait_s)
        return self._is_well and not self.hangs

    @property
    def hangs(self) -> bool:
        """Return whether the present look takes longer than any should."""
        with self._beginning:
            return not self._ended.is_set() and self._clock.now() - self._begun > self._longest_s

    def _look(self, ended: threading.Event) -> None:
        try:
            self._is_well = not self._trouble()
        finally:
            ended.set()
