"""Progress and warnings of commands on stderr: bars on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import click
from tqdm import tqdm

from lightpage.progress import Progress, State

T = TypeVar("T")

LINE_S = 30.0
"""Seconds from one line to the next where stderr is no terminal."""


class _Lines(tqdm):  # type: ignore[type-arg]
    """A line now and then in place of a bar, so that a log can be read."""

    def __init__(self, items: Iterable[Any] | None = None, **settings: Any) -> None:
        settings["bar_format"] = "lightpage: {desc} {percentage:.0f}% after {elapsed}, about {remaining} left{postfix}"
        super().__init__(items, mininterval=LINE_S, miniters=1, delay=LINE_S, **settings)

    @property
    def format_dict(self) -> dict[str, Any]:
        """Return what a line is made of; tqdm itself ends some descriptions with a colon and some without."""
        parts = dict(super().format_dict)
        parts["prefix"] = f"{str(parts['prefix']).rstrip(': ')}:"
        return parts

    @staticmethod
    def status_printer(file: Any) -> Callable[[str], None]:
        """Lines that stay, where a bar would be drawn over itself."""
        return lambda text: print(text, file=file, flush=True) if text.strip() else None


def bar(items: Iterable[T] | None = None, **settings: Any) -> tqdm[T]:
    """A bar over the items, or one that is moved by its `update`; settings as for `tqdm`."""
    kind = tqdm if sys.stderr.isatty() else _Lines
    shown: tqdm[T] = kind(items, **settings)
    return shown


class Bars:
    """Shows loops that track their items; see `lightpage.progress.Reporter`."""

    def track(
        self, items: Iterable[T], what: str, unit: str, total: int | None, done: int, state: State
    ) -> Iterator[T]:
        """See `Reporter`."""
        with bar(items, desc=what, unit=unit, total=total, initial=done) as shown:
            for item in shown:
                yield item
                shown.set_postfix_str(state(), refresh=False)

    def note(self, what: str) -> None:
        """See `Reporter`."""
        click.echo(f"lightpage: {what}", err=True)


@contextmanager
def percent_bar() -> Iterator[Progress]:
    """A bar as the callback that tells of progress; it is full when the `with` statement ends well."""
    shown: tqdm[object] = bar(total=100, unit="%", bar_format="{desc}{percentage:3.0f}%|{bar}| {elapsed}")
    with shown:

        def progress(step: str, share: float) -> None:
            shown.set_description(step, refresh=False)
            shown.update(max(0.0, 100 * share - shown.n))
            if not isinstance(shown, _Lines):
                shown.refresh()

        yield progress
        progress("done", 1.0)
