"""What is noted of every page, given out or lost, for those who watch the device: monitor, console, flight recorder."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.page_bytes import PageBytes
from lightpage.errors import FramesDisagreeError, LostPageError, Reason, SourceError, UnconfirmedPageError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import unconfirmed_page

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Observation:
    """One page.

    Attributes:
        subject: for people, e.g. ``page 3 of recording:R.h5``.
        page_index: its number in the source, None where a caller sent its frames, or nobody knows.
        model_version: what decoded it.
        time_s: seconds since 1970.
        seconds: that it took, waiting for a slot left out.
        lost: why it was not given out, None where it was.
        detail: of the loss, for people.
        tells: whether it says something of the device. A lost page whose pilots a caller sent does not: they
            may be wrong.
        of_device: whether it is of the service's own device, and not of frames of a caller's own session.
        pair: its frames, None where no pair was photographed.
        infos: what the cameras said of them.
        page: what was decoded, of a page that its pilots do not confirm too; None where nothing was.
        user_data: its bytes, None where nobody asked for them.
        levels: M of what was written, None where nobody knows.
        symbols: what was written, uint8 [ny, nx], None where nobody knows.
        pilot_mask: where its pilots are, bool [ny, nx], None for the model's usual positions.
    """

    subject: str
    page_index: int | None
    model_version: str
    time_s: float
    seconds: float
    lost: Reason | None = None
    detail: str = ""
    tells: bool = True
    of_device: bool = True
    pair: FramePair | None = None
    infos: tuple[FrameInfo, FrameInfo] | None = None
    page: DecodedPage | None = None
    user_data: PageBytes | None = None
    levels: int | None = None
    symbols: NDArray[np.uint8] | None = None
    pilot_mask: NDArray[np.bool_] | None = None


class Observer(Protocol):
    """Is told of every page, by the thread that decoded it: it must be quick, and may be called by many at once."""

    def observe(self, observation: Observation) -> None:
        """Take note of a page."""


class Seen:
    """What becomes known of a page while it is read and decoded.

    Args:
        subject, page_index, model_version: see `Observation`.
        clock: seconds since 1970.
        lap: seconds that never go back, by which the page is timed.
    """

    def __init__(
        self,
        subject: str,
        page_index: int | None,
        model_version: str,
        clock: Callable[[], float] = time.time,
        lap: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._clock, self._lap = clock, lap
        self.observation = Observation(subject, page_index, model_version, clock(), 0.0)
        self._begun = lap()

    def note(self, **known: Any) -> None:
        """Take in fields of `Observation`."""
        self.observation = replace(self.observation, **known)

    def ended(self, lost: Reason | None, detail: str) -> Observation:
        """The observation of the page, which was given out or lost now."""
        seconds = self._lap() - self._begun
        return replace(self.observation, time_s=self._clock(), seconds=seconds, lost=lost, detail=detail)


@contextmanager
def observed(observers: Sequence[Observer], seen: Seen) -> Iterator[Seen]:
    """Tell the observers of a page that is read and decoded inside the block, given out or lost.

    A page of the source whose frames contradict each other is told of as lost, with an unspecified reason. Other errors
    say nothing of a page. What an observer raises is logged: it costs nobody a page.
    """
    try:
        yield seen
    except LostPageError as error:
        if isinstance(error, UnconfirmedPageError):
            seen.note(page=unconfirmed_page(error))
        _tell(observers, seen, error.reason, str(error))
        raise
    except SourceError as error:
        if isinstance(error.__cause__, FramesDisagreeError):
            _tell(observers, seen, Reason.UNSPECIFIED, str(error))
        raise
    _tell(observers, seen, None, "")


def _tell(observers: Sequence[Observer], seen: Seen, lost: Reason | None, detail: str) -> None:
    if not observers:
        return
    observation = seen.ended(lost, detail)
    for observer in observers:
        try:
            observer.observe(observation)
        except Exception:
            _log.exception("%s could not take note of %s", type(observer).__name__, observation.subject)
