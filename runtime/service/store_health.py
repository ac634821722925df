"""Whether the store can be written, as health checks tell it: a disk that hangs must not silence the rest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

LONGEST_S = 5.0
"""A look at the store that takes longer has hung."""


class StoreHealth:
    """Looks at the store in a thread of its own, which does not hold the end of the process either.

    Args:
        trouble: says what is wrong with the store, nothing where it is well.
        longest_s: a look that takes longer has hung.
        clock: seconds that never go back.
    """

    def __init__(
        self, trouble: Callable[[], str], longest_s: float = LONGEST_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._trouble, self._longest_s, self._clock = trouble, longest_s, clock
        self._thread: threading.Thread | None = None
        self._begun = 0.0
        self._is_well = True

    def is_well(self) -> bool:
        """What the last look that ended found, without waiting; begins the next one. One caller at a time."""
        if self._thread is None or not self._thread.is_alive():
            self._begun = self._clock()
            self._thread = threading.Thread(target=self._look, name="lightpage-store-look", daemon=True)
            self._thread.start()
            return self._is_well
        return self._is_well and self._clock() - self._begun <= self._longest_s

    def _look(self) -> None:
        self._is_well = not self._trouble()
