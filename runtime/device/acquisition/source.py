"""The interface of frame sources, and the opening of one by its name.

Sources are entry points of the group `lightpage.sources`, so that another package may bring its own.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.errors import FrameError, InvalidInputError, LostShotError, RecordingError, SourceError, raised_as
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import FrameInfo
from lightpage.recording.pixels.black_level import DarkFrame
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.modulator.modulator import Beams, Modulator
from lightpage.runtime.device.plugins import SOURCES, driver_of, names_of

SHOT_S = 10.0
"""Usual time that a shot may take."""


def nobody(text: str) -> None:
    """The operator of a device that nobody stands beside.

    Raises:
        SourceError: always.
    """
    raise SourceError("operator", "nobody", f"somebody who does this, as `lightpage record` asks: {text}")


@dataclass(frozen=True)
class Shot:
    """A page as a source photographed it.

    Attributes:
        pair: both frames.
        page_index: which page.
        symbols: what was written, uint8 [ny, nx], or None where nobody knows.
        pilot_mask: where the pilots are, bool [ny, nx], or None for the device's usual positions.
        infos: information of the in-phase and the quadrature frame, or None where there were no cameras.
    """

    pair: FramePair
    page_index: int
    symbols: NDArray[np.uint8] | None = None
    pilot_mask: NDArray[np.bool_] | None = None
    infos: tuple[FrameInfo, FrameInfo] | None = None


class FrameSource(ABC):
    """A thing to read pages from, to be used in a `with` statement: armed inside it, closed behind it.

    Its methods may be called from many threads. A source of your own sets the attributes and overrides `shot`, and what
    else it can do.

    Attributes:
        name: name for people, e.g. ``recording:R.h5``.
        levels: level count of its pages.
        bit_depth: bits of a camera count.
        frame_shape: (rows, columns) of its frames.
        shot_s: longest wait for a page where its caller does not give up before.
        page_shape: (rows, columns) of its pages where it knows them, else None.
        profile: nominal device, where it knows it.
        pages: what its modulator shows, where it has one that shows what it is given.
        modulator, beams: modulator and beams of a device that has them.
        operator: is asked to do by hand what the device cannot; returns once that is done.
        on_lost: is told of every lost shot and its page's number, of those too that a further shot made good.
    """

    name: str
    levels: int
    bit_depth: int
    frame_shape: tuple[int, int]
    shot_s: float = SHOT_S
    page_shape: tuple[int, int] | None = None
    profile: Profile | None = None
    pages: PageStore | None = None
    modulator: Modulator | None = None
    beams: Beams | None = None
    operator: Callable[[str], None] = staticmethod(nobody)
    on_lost: Callable[[int, LostShotError], None] = staticmethod(lambda page, error: None)

    @abstractmethod
    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        """Photograph page number `page`, or the next one.

        Args:
            timeout_s: longest wait for it.
            page: which.

        Raises:
            PageError: there is no such page.
            LostShotError: this shot is lost, and says why; the next one may succeed.
            SourceError: the source is missing, damaged or dark.
        """

    def check_against(self, profile: Profile) -> None:
        """Raise `InvalidInputError` unless frames and pages have the shapes of `profile`."""
        pages = profile.page_shape if self.page_shape is None else self.page_shape
        if (own := (self.frame_shape, pages)) != (expected := (profile.frame_shape, profile.page_shape)):
            raise InvalidInputError(f"source {self.name}", f"frames and pages of {own}", f"{expected}")

    def arm(self) -> None:  # noqa: B027 — a source without a device needs none
        """Make ready for shots; `disarm` and `arm` may take turns.

        Raises:
            SourceError: it cannot be made ready.
        """

    def disarm(self) -> None:  # noqa: B027 — a source without a device needs none
        """Stop being ready for shots, and leave the device in peace."""

    def references(self) -> FramePair | None:
        """Reference-only frames as they are now, where the source has them.

        Raises:
            LostShotError, SourceError: see `shot`.
        """
        return None

    def dark_frames(self) -> tuple[DarkFrame, DarkFrame] | None:
        """Return what both cameras see without light, taken now, where the source can; it minds them from here on.

        Raises:
            LostShotError, SourceError: see `shot`.
        """
        return None

    def page_count(self) -> int | None:
        """Return the number of its pages: 0 where it has none yet, None where any number can be photographed."""
        return None if self.pages is None else len(self.pages) or None

    def show_pages(self, pages: PageStore) -> None:
        """Show these pages from now on.

        Raises:
            SourceError: it shows none that it is given.
        """
        raise SourceError(f"source {self.name}", "pages to show", "a source with a modulator")

    def shots_by_outcome(self) -> Mapping[str, int]:
        """Shots so far by how they ended: ``TAKEN``, or the reason of the loss; empty where nobody counts."""
        return {}

    def saturated_shares(self) -> Mapping[str, float]:
        """Share of pixels at full scale in each camera's last frame; empty where nobody looks."""
        return {}

    def trouble(self) -> str:
        """Why no page of it can be read now, empty where one can; it must not wait for a device."""
        return ""

    def close(self) -> None:  # noqa: B027 — a source without a device needs none
        """Let go of files and devices."""

    def __enter__(self) -> Self:
        try:
            self.arm()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        try:
            self.disarm()
        finally:
            self.close()


def own_fault(subject: str = "") -> AbstractContextManager[None]:
    """Turn what is wrong with a source's file or frames into the service's fault; no such page stays that.

    Raises:
        SourceError: in place of a `RecordingError` or `FrameError`; `subject` goes before what it names.
        StorageError: storage fails, which says nothing of the source.
    """
    return raised_as(SourceError, RecordingError, FrameError, about=subject)


def open_source(spec: str) -> FrameSource:
    """Open a source by its name.

    Args:
        spec: KIND:REST, e.g. ``recording:FILE``, or ``simulator:PROFILE`` (a shipped name or a file), which
            ``?levels=16&seed=0&device=FILE`` may follow.

    Raises:
        InvalidInputError: another kind, or one whose recording, profile or device does not validate.
    """
    kinds = names_of(SOURCES)
    kind, colon, rest = spec.partition(":")
    if not (colon and rest and kind in kinds):
        expected = f"KIND:REST, KIND being one of {', '.join(kinds)}, e.g. recording:FILE or simulator:PROFILE"
        raise InvalidInputError("source", repr(spec), expected)
    opener: Callable[[str], FrameSource] = driver_of(SOURCES, kind, f"source {spec}")
    return opener(rest)
