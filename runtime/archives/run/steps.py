"""What a worker is at with a device: told to whoever started it, and kept in a log."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from lightpage.progress import State

T = TypeVar("T")

EVERY_S = 30.0
"""Seconds from one line of a step to the next."""


class StepLog:
    """Tells of steps in lines; see `lightpage.progress.Reporter`.

    Args:
        path: of the log, which is gone on with.
        tell: called with each line.
        clock: by which lines are told now and then.
    """

    def __init__(self, path: Path, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._tell, self._clock = path, tell, clock
        self._step, self._next = "", 0.0

    def track(
        self, items: Iterable[T], what: str, unit: str, total: int | None, done: int, state: State
    ) -> Iterator[T]:
        """See `Reporter`."""
        number = done
        for number, item in enumerate(items, done + 1):
            yield item
            self._now(what, f"{unit} {number}" + (f" of {total}" if total else ""), state)
        self.note(f"{what}: {number} {unit}s" + (f", {state()}" if state() else ""))

    def note(self, what: str) -> None:
        """See `Reporter`."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {what}\n")
        self._tell(what)

    def progress(self, step: str, share: float) -> None:
        """See `lightpage.progress.Progress`."""
        self._now(step, f"{share:.0%}", lambda: "")

    def _now(self, step: str, where: str, state: State) -> None:
        """A line when a step begins, and then one every so often."""
        if step == self._step and self._clock() < self._next:
            return
        self._step, self._next = step, self._clock() + EVERY_S
        self.note(f"{step}: {where}" + (f", {state()}" if state() else ""))
