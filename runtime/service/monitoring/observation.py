"""Observations of every page, given out or lost, for monitor, console and flight recorder."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.page_bytes import PageBytes
from lightpage.errors import Reason
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.model.decoding.page import DecodedPage


@dataclass(frozen=True)
class Observation:
    """An observation of one page.

    Attributes:
        subject: subject for people, e.g. ``page 3 of recording:R.h5``.
        page_index: its number in the source, None where a caller sent its frames, or nobody knows.
        model_version: what decoded it.
        time_s: seconds since 1970.
        seconds: time that it took, waiting for a slot left out.
        lost: why it was not given out, None where it was.
        detail: detail of the loss, for people.
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
