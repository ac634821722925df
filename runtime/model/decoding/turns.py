"""Pages that are worked on at the same time, and are taken in their order all the same."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_LOOK_S = 0.1
"""How often whoever waits looks whether it still should."""


def patiently() -> None:
    """Wait on, whatever happens."""


class Turn:
    """A page's place among others; closed once the next one may go on. In a `with` statement, it is its turn.

    Args:
        turns: all turns of the device.
        number: number of this turn.
        waiting: see `Turns.take`.
    """

    def __init__(self, turns: Turns, number: int, waiting: Callable[[], None]) -> None:
        self._turns, self._number, self._waiting = turns, number, waiting

    def wait(self, interrupts: Callable[[int], bool] = lambda before: False) -> bool:
        """Wait until all pages before are closed, and return whether they are.

        Args:
            interrupts: whether to go on with so many pages before; it is asked again behind each change.

        Raises what is raised of `waiting`, see `Turns.take`.
        """
        return self._turns.wait(self._number, interrupts, self._waiting)

    def close(self) -> None:
        """Let the page behind have its turn."""
        self._turns.close(self._number)

    def __enter__(self) -> Turn:
        try:
            self.wait()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Turns:
    """The turns of one device's pages. For many threads."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        """Held while turns, or what the pages have taught, are looked at or changed; notified behind a change."""
        self._next = 0
        self._open: set[int] = set()

    def take(self, waiting: Callable[[], None] = patiently) -> Turn:
        """The turn behind all that were taken.

        Args:
            waiting: is called again and again while its page waits for others; what it raises ends that.
        """
        with self.changed:
            self._next += 1
            self._open.add(self._next)
            return Turn(self, self._next, waiting)

    @contextmanager
    def taken(self, turn: Turn | None) -> Iterator[Turn]:
        """This turn, or the next one, which is closed at the end of the `with` statement at the latest."""
        turn = turn or self.take()
        try:
            yield turn
        finally:
            turn.close()

    def wait(self, number: int, interrupts: Callable[[int], bool], waiting: Callable[[], None]) -> bool:
        """See `Turn.wait`."""

        def before() -> int:
            return sum(one < number for one in self._open)

        with self.changed:
            while not self.changed.wait_for(lambda: not before() or interrupts(before()), _LOOK_S):
                waiting()
            return not before()

    def close(self, number: int) -> None:
        """See `Turn.close`."""
        with self.changed:
            self._open.discard(number)
            self.changed.notify_all()
