"""A reporter that remembers what it was told."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TypeVar

from lightpage.progress import State

T = TypeVar("T")


@dataclass
class Told:
    """See `lightpage.progress.Reporter`; `notes` has what was told."""

    notes: list[str] = field(default_factory=list)

    def track(
        self, items: Iterable[T], what: str, unit: str, total: int | None, done: int, state: State
    ) -> Iterable[T]:
        return items

    def note(self, what: str) -> None:
        self.notes.append(what)
