"""Pages of a recording, decoded in their order: several at a time where they are computed together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.read_ahead import beside, read_ahead
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.model.decoding.turns import Turn

T = TypeVar("T")
Symbols = NDArray[np.uint8] | None


@dataclass(frozen=True)
class Shown:
    """A page that is on its way.

    Attributes:
        index: its number in the recording.
        read: its frames and, where they are known, its symbols.
        tracker: that it is decoded with.
        turn: of that.
    """

    index: int
    read: Future[tuple[FramePair, Symbols]]
    tracker: Tracker
    turn: Turn


def decoded_ahead(
    recording: Recording,
    pages: Iterable[int],
    tracker: Callable[[], Tracker],
    together: int,
    decode: Callable[[Shown, FramePair, Symbols], T],
) -> Iterator[tuple[int, Callable[[], tuple[T, Symbols]]]]:
    """Every page's number, and what gives its decoded form and its symbols, in order.

    Args:
        recording: of the pages.
        pages: their numbers.
        tracker: gives that of the model in use. Pages that another one decoded ahead are decoded again.
        together: pages that are computed together at most.
        decode: decodes a page with its tracker, in its turn.
    """

    def decoded(page: Shown) -> tuple[T, Symbols]:
        with closing(page.turn):
            frames, symbols = page.read.result()
            return decode(page, frames, symbols), symbols

    def shown(index: int, read: Future[tuple[FramePair, Symbols]]) -> Shown:
        return Shown(index, read, now := tracker(), now.turn())

    ahead = (shown(*each) for each in read_ahead(recording.shown, pages))
    for page, result in beside(decoded, ahead, 2 * together if together > 1 else 1):
        yield page.index, result if page.tracker is tracker() else partial(decoded, shown(page.index, page.read))
