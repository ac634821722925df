"""Errors that only decoding and a running service have, beside those of `optics/errors.py`."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Self

from optics.errors import BusyError, LightpageError

if TYPE_CHECKING:
    from runtime.decoder import DecodedPage


class SourceError(LightpageError):
    """The service's own source or recordings are missing, damaged or dark: nothing that the caller sent is wrong."""


class StoppingError(LightpageError):
    """The service is being stopped and drops the work."""


class SlotsTakenError(BusyError):
    """The service does as much as it may at once, and did so until the caller's time was up."""


class Reason(StrEnum):
    """Why a page is lost."""

    UNSPECIFIED = "UNSPECIFIED"
    PILOTS_DISAGREE = "PILOTS_DISAGREE"
    """The image is where it was looked at, or nobody looked for it, and the pilots contradict what was decoded."""
    IMAGE_NOT_FOUND = "IMAGE_NOT_FOUND"
    """The image was looked for and is not there: it lies further off, or the frames are not this page's."""


class LostPageError(LightpageError):
    """A page could not be read, and nothing that the caller sent need be wrong: write or read it again.

    Args:
        thing, got, wanted: see `LightpageError`.
        reason: why.
        recalibration_due: whether the device has changed since it was calibrated, as far as this page shows.
    """

    def __init__(
        self,
        thing: str,
        got: object,
        wanted: object,
        reason: Reason = Reason.UNSPECIFIED,
        recalibration_due: bool = False,
    ) -> None:
        super().__init__(thing, got, wanted)
        self.reason, self.recalibration_due = reason, recalibration_due

    def about(self, thing: str) -> Self:
        """The same error about a page that is known by another name."""
        return type(self)(thing, self.got, self.wanted, self.reason, self.recalibration_due)


class UnconfirmedPageError(LostPageError):
    """The pilots of a page do not bear out what the decoder claims of it: its symbols would be noise.

    Attributes:
        page: what was decoded, for figures and never for an answer; None on the client's side.
    """

    page: DecodedPage | None = None

    def about(self, thing: str) -> Self:
        """See `LostPageError`."""
        other = super().about(thing)
        other.page = self.page
        return other
