"""What a frame source is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.errors import FrameError, RecordingError
from lightpage.recording.reader import FramePair
from runtime.errors import SourceError


@dataclass(frozen=True)
class SourcePage:
    """One page as a source delivers it.

    Attributes:
        pair: both frames.
        page_index: which page.
        symbols: what was written, uint8 [ny, nx], or None where nobody knows.
        pilot_mask: where the pilots are, bool [ny, nx], or None for the device's usual positions.
    """

    pair: FramePair
    page_index: int
    symbols: NDArray[np.uint8] | None = None
    pilot_mask: NDArray[np.bool_] | None = None


class FrameSource(Protocol):
    """A thing to read pages from; its methods may be called from many threads."""

    @property
    def name(self) -> str:
        """For people, e.g. ``recording:R.h5``."""

    @property
    def levels(self) -> int:
        """Level count of its pages."""

    @property
    def bit_depth(self) -> int:
        """Bits of a camera count."""

    def check_against(self, profile: Profile) -> None:
        """Raise `InvalidInputError` unless its frames and pages have the shapes of `profile`."""

    def read(self, page: int | None = None) -> SourcePage:
        """Read page number `page`, or the next one; raises `PageError` where there is no such page."""

    def references(self) -> FramePair | None:
        """Reference-only frames as they are now, where the source has them."""

    def close(self) -> None:
        """Let go of files and devices."""


@contextmanager
def own_fault(subject: str = "") -> Iterator[None]:
    """Turn what is wrong with a source's file or frames into the service's fault; a page that is not there stays.

    Raises:
        SourceError: in place of a `RecordingError` or `FrameError`; `subject` goes before what it names.
    """
    try:
        yield
    except (RecordingError, FrameError) as error:
        raise SourceError(subject + error.subject, error.got, error.expected) from error
