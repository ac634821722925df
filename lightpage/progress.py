"""Progress of long work; its caller decides how it is shown, and by default it is not."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol, TypeVar

_log = logging.getLogger(__name__)

T = TypeVar("T")

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of the work that is behind, 0 to 1. It may raise to stop the work."""
State = Callable[[], str]


def part(progress: Progress, begin: float, end: float) -> Progress:
    """Return the progress of a part of the work, which lies between the shares `begin` and `end` of the whole."""
    return lambda what, share: progress(what, begin + share * (end - begin))


class Reporter(Protocol):
    """Shows how far a loop has come."""

    def track(
        self, items: Iterable[T], what: str, unit: str, total: int | None, done: int, state: State
    ) -> Iterable[T]:
        """Yield the items, and show progress over `total`, of which an earlier run has done `done`."""

    def note(self, what: str) -> None:
        """Show a note."""


_reporter: ContextVar[Reporter | None] = ContextVar("reporter", default=None)


@contextmanager
def reporting(reporter: Reporter | None) -> Iterator[None]:
    """Show the loops of this thread that `track` their items by `reporter`, or not at all, in the `with` statement."""
    token = _reporter.set(reporter)
    try:
        yield
    finally:
        _reporter.reset(token)


def note(what: str) -> None:
    """Note what those who watch the work should know."""
    reporter = _reporter.get()
    if reporter is None:
        _log.info(what)
    else:
        reporter.note(what)


def warn(what: str) -> None:
    """Warn whoever watches of what may be wrong."""
    if _reporter.get() is None:
        _log.warning(what)
    else:
        note(f"warning: {what}")


def track(
    items: Iterable[T],
    what: str,
    *,
    unit: str = "page",
    total: int | None = None,
    done: int = 0,
    state: State = lambda: "",
) -> Iterable[T]:
    """The items themselves, the way through them shown to whoever watches.

    Args:
        items: items of a loop.
        what: name of the work.
        unit: name of an item.
        total: how many there are, with those that are done already; by default as many as `items` has.
        done: how many of them an earlier run has done, which are not among `items`.
        state: says in a word or two, after each item, how the work stands.
    """
    reporter = _reporter.get()
    return items if reporter is None else reporter.track(items, what, unit, total, done, state)
