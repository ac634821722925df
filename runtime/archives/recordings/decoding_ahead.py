"""Pages of a recording, decoded in their order: several at a time where they are computed together."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import closing
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.read_ahead import beside, read_ahead
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.model.decoding.turns import Turn
from lightpage.runtime.model.execution.cpus import available_cpus

_READERS = 4
"""Threads that read pages for batches. The number is a guess: nothing was timed on an idle machine."""

T = TypeVar("T")
Symbols = NDArray[np.uint8] | None


@dataclass(frozen=True)
class Shown:
    """A page that is on its way.

    Attributes:
        index: number of the page in the recording.
        read: frames and, where they are known, symbols of the page.
        tracker: tracker that decodes it.
        turn: turn of the page.
    """

    index: int
    read: Future[tuple[FramePair, Symbols]]
    tracker: Tracker
    turn: Turn


def decoded_ahead(
    recording: Recording,
    pages: Sequence[int],
    tracker: Callable[[], Tracker],
    together: int,
    decode: Callable[[Shown, FramePair, Symbols], T],
) -> Iterator[tuple[int, Callable[[], tuple[T, Symbols]]]]:
    """Every page's number, and what gives its decoded form and its symbols, in order.

    What was decoded ahead is dropped once another model is in use, which then sees the pages from there on in order.

    Args:
        recording: recording of the pages.
        pages: their numbers.
        tracker: gives that of the model in use.
        together: pages that are computed together at most.
        decode: decodes a page with its tracker, in its turn.
    """

    def decoded(page: Shown) -> tuple[T, Symbols]:
        frames, symbols = page.read.result()
        return decode(page, frames, symbols), symbols

    def begun(now: Tracker) -> Iterator[Shown]:
        with closing(read_ahead(recording.shown, pages[done:], readers)) as shown:
            for index, read in shown:
                if tracker() is not now:
                    return
                yield Shown(index, read, now, now.turn())

    def over(page: Shown) -> None:
        page.turn.close()

    done, threads = 0, 2 * together if together > 1 else 1
    readers = min(_READERS, available_cpus()) if together > 1 else 1
    while done < len(pages):
        with closing(beside(decoded, begun(now := tracker()), threads, over)) as ahead:
            for page, result in ahead:
                if tracker() is not now:
                    break
                done += 1
                yield page.index, result
