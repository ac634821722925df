"""What commands say on their way: a progress bar in per cent, and warnings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click
from tqdm import tqdm

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of the work that is behind, 0 to 1. It may raise to stop the work."""


@contextmanager
def percent_bar() -> Iterator[Progress]:
    """A bar as the callback that tells of progress; it is full when the `with` statement ends well."""
    with tqdm(total=100, unit="%", bar_format="{desc}{percentage:3.0f}%|{bar}| {elapsed}") as bar:

        def progress(step: str, share: float) -> None:
            bar.set_description(step, refresh=False)
            bar.update(max(0.0, 100 * share - bar.n))
            bar.refresh()

        yield progress
        progress("done", 1.0)


def warn(what: str) -> None:
    """Say on stderr what the user should know of work that goes on."""
    click.echo(f"lightpage: warning: {what}", err=True)
