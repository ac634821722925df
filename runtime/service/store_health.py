"""Whether the store can be written, for health checks and metrics: a disk that hangs must not silence the rest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

LONGEST_S = 5.0
"""A look at the store that takes longer has hung."""


class StoreHealth:
    """Looks at the store in a thread of its own, which does not hold the end of the process either.

    It may be asked from many threads.

    Args:
        trouble: says what is wrong with the store, nothing where it is well.
        longest_s: a look that takes longer has hung.
        clock: seconds that never go back.
    """

    def __init__(
        self, trouble: Callable[[], object], longest_s: float = LONGEST_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._trouble, self._longest_s, self._clock = trouble, longest_s, clock
        self._lock = threading.Lock()
        """Held while a look begins, so that there is one at a time."""
        self._thread: threading.Thread | None = None
        self._begun = 0.0
        self._is_well = True

    def is_well(self, wait_s: float = 0.0) -> bool:
        """What the last look that ended found; begins the next one, and waits for its end for `wait_s` at most."""
        with self._lock:
            look = self._thread
            if look is None or not look.is_alive():
                self._begun = self._clock()
                look = threading.Thread(target=self._look, name="lightpage-store-look", daemon=True)
                look.start()
                self._thread = look
        if wait_s > 0 and not self.hangs:
            look.join(wait_s)
        return self._is_well and not self.hangs

    @property
    def hangs(self) -> bool:
        """Whether the present look takes longer than any should."""
        with self._lock:
            is_looking = self._thread is not None and self._thread.is_alive()
            return is_looking and self._clock() - self._begun > self._longest_s

    def _look(self) -> None:
        self._is_well = not self._trouble()
