"""Pages of one device in their order, and the rule that none is given out that its pilots do not confirm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from pydantic import BaseModel, ConfigDict

from lightpage.calibration.image_search import REACH_PX, FoundImage
from lightpage.errors import Reason, UnconfirmedPageError
from lightpage.page.pilots import LEAST_CONFIRMED_SHARE, Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage, StepLimit
from lightpage.runtime.model.decoding.turns import Turn, Turns, patiently


class TrackerMemory(BaseModel):
    """Plain numbers that a tracker has learnt of a device, so that another process can go on from there.

    Attributes:
        drift: shift x, y (camera pixels) and tilt x, y (radians) since calibration, [4].
        covariance: covariance of the drift of the next page about it, [4, 4].
        walk: variance of the drift from one page to the next, [4].
        traced_tilt: radians, tilt that the table was traced with, [2].
        settled: whether a page was confirmed yet.
        jump_px: shift of which it is not known whether the reference has come along, (x, y).
        share: share of the claimed information that pilots lately confirmed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    drift: tuple[float, float, float, float]
    covariance: tuple[tuple[float, float, float, float], ...]
    walk: tuple[float, float, float, float]
    traced_tilt: tuple[float, float]
    settled: bool
    jump_px: tuple[float, float]
    share: float


class Tracker(Protocol):
    """Decodes the pages of one device in their order; calls come from many threads."""

    def turn(self, waiting: Callable[[], None] = patiently) -> Turn:
        """The page's turn that comes next, for whoever has pages decoded at the same time and says in which order.

        Args:
            waiting: see `Turns.take`.
        """

    def decode(
        self,
        pair: FramePair,
        levels: int,
        pilots: Pilots | None = None,
        turn: Turn | None = None,
        limit: StepLimit | None = None,
    ) -> DecodedPage:
        """Decode a page.

        Args:
            pair, levels, pilots: as for `Decoder.decode`.
            turn: turn of the page; by default it comes behind all that have begun. It is closed at the end.
            limit: limit on the time of the steps of each inference.

        Raises:
            UnconfirmedPageError: the page's pilots do not bear out what the decoder claims of it.
            FrameError, PageError: see `Decoder.decode`.
        """

    @property
    def image_px(self) -> tuple[float, float]:
        """Return where the image of the last page lay against calibration, (x, y), camera pixels."""

    def memory(self) -> TrackerMemory | None:
        """Return what it has learnt until now, for `tracker_for` in another process; None where it learns nothing."""

    def anew(self) -> Tracker:
        """Return a new tracker for the same bundle, without state."""

    def fork(self) -> Tracker:
        """Return a copy that goes on by itself."""

    def refitted(self, decoder: Decoder) -> Tracker:
        """A new one for the decoder of a re-fitted bundle of the same device.

        Raises:
            BundleError, CalibrationError: as for `tracker_for`.
        """


class NoTracker:
    """Follows nothing: the bundle's own table for every page.

    Args:
        decoder: decodes every page.
    """

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder

    def turn(self, waiting: Callable[[], None] = patiently) -> Turn:
        """See `Tracker`: one that waits for nothing."""
        return Turns().take(waiting)

    def decode(
        self,
        pair: FramePair,
        levels: int,
        pilots: Pilots | None = None,
        turn: Turn | None = None,
        limit: StepLimit | None = None,
    ) -> DecodedPage:
        """See `Tracker`."""
        return confirmed(self._decoder.decode(pair, levels, pilots, limit))

    @property
    def image_px(self) -> tuple[float, float]:
        """Return the image's calibrated position."""
        return 0.0, 0.0

    def memory(self) -> None:
        """See `Tracker`."""

    def anew(self) -> NoTracker:
        """Return this tracker, which has no state to copy."""
        return self

    def fork(self) -> NoTracker:
        """Return this tracker, which has no state to copy."""
        return self

    def refitted(self, decoder: Decoder) -> NoTracker:
        """See `Tracker`."""
        return NoTracker(decoder)


def confirmed(page: DecodedPage, found: FoundImage | None = None) -> DecodedPage:
    """The page itself, if its pilots bear out what is claimed of it.

    Args:
        page: decoded.
        found: outcome of a search for its image, None where none was made.

    Raises:
        UnconfirmedPageError: they do not.
    """
    check = page.check
    if check.confirmed:
        return page
    lost = found is not None and not found.found
    looked = f"; its image was looked for within {REACH_PX:g} px and {'not ' if lost else ''}found" if found else ""
    told = f"{max(0.0, check.confirmed_bits):.2f} of {check.claimed_bits:.2f} claimed bits a symbol confirmed{looked}"
    if check.agrees:
        reason = Reason.TOO_FEW_PILOTS
        told = f"{check.pilots} that tell {check.pilots * max(0.0, check.confirmed_bits):.0f} bits together{looked}"
        expected = "more pilots, or more light: as much may be chance"
    else:
        reason = Reason.IMAGE_NOT_FOUND if lost else Reason.PILOTS_DISAGREE
        cure = "its image lies further off or it has changed, calibrate anew" if lost else "it has changed, recalibrate"
        share = f"at least {LEAST_CONFIRMED_SHARE:.0%} of them"
        expected = f"{share}: frames and pilots of this device, as it was calibrated (if {cure})"
    raise UnconfirmedPageError("pilots", told, expected, reason, check.recalibration_due).of(page)


def unconfirmed_page(error: UnconfirmedPageError) -> DecodedPage:
    """Return what was decoded of the page that an error of this process is about."""
    assert isinstance(error.page, DecodedPage)
    return error.page
