"""A progress bar in per cent, for work that tells of its steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

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
