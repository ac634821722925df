"""Judgement of a re-fitted model against the one in service."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError, LostPageError, RecalibrationRefusedError, UnconfirmedPageError
from lightpage.metrics.information import achievable_rate
from lightpage.page.pilots import Pilots
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import Tracker, unconfirmed_page
from lightpage.runtime.recalibration.known_pages import KnownPages

MIN_AIR_SHARE = 0.02
"""Share of log2 M below which a held-back page does not match its symbols at all: wrong pilots, wrong device."""

DRIFTED_PX, DRIFTED_RAD, DRIFTED_STROKE = 1.0, 0.01, 0.002
"""Shift of the image, smooth phase error and error of the stroke from which on a decoder has a drift to follow. A quiet
bench device shows 0.1 px and 0.002 rad; the monitor speaks of 4 px and 0.03 rad, and of that stroke."""

GAIN_ERRORS = 2
"""Standard errors that a re-fit of a device that has not drifted must gain. It fits by one page a geometry that was
found by many, so it loses 0 to 4 of them as a rule, and now and then it gains one."""


@dataclass(frozen=True)
class JudgedPage:
    """A held-back page as a decoder reads it.

    Attributes:
        information: contribution of each data symbol to the AIR, bits, 1-D in the order of the page; zeros for a page
            that is not decoded.
        lost: why the page would not have been given out, None where it would.
        drifted: whether the decoder followed a drift to read it, or does not know: then a new geometry may be worth
            while even where it reads no more.
    """

    information: NDArray[np.float64]
    lost: LostPageError | FrameError | None = None
    drifted: bool = True

    @property
    def air(self) -> float:
        """AIR over the data symbols, bits per symbol."""
        return float(self.information.mean())


@dataclass(frozen=True)
class Verdict:
    """Figures of two decoders on the same held-back pages, bits per symbol.

    Attributes:
        before: AIR of the one in service; pages that it would not give out count with no bits.
        after: AIR of the new one.
        error: standard error of the difference, from the differences symbol by symbol.
        drifted: whether the one in service had a drift to follow, or lost a page.
    """

    before: float
    after: float
    error: float
    drifted: bool

    @property
    def limit(self) -> float:
        """AIR that the new one must have: `before` less `error`; where nothing has drifted, `GAIN_ERRORS` above it."""
        return self.before + (-self.error if self.drifted else GAIN_ERRORS * self.error)


def judged_pages(
    tracker: Tracker, bundle: Bundle, pages: KnownPages, progress: Callable[[float], None]
) -> list[JudgedPage]:
    """The pages, as a service reads them with this tracker."""
    mask = bundle.pilot_mask if pages.pilot_mask is None else pages.pilot_mask
    data, judged, levels = ~mask, list[JudgedPage](), bundle.levels(pages.levels)
    for pair, symbols in zip(pages.pairs, pages.symbols, strict=True):
        progress(len(judged) / len(pages.pairs))
        lost = None
        try:
            page = tracker.decode(pair, pages.levels, Pilots.of_symbols(mask, symbols, levels))
        except FrameError as error:
            judged.append(JudgedPage(np.zeros(np.count_nonzero(data)), error))
            continue
        except UnconfirmedPageError as error:
            page, lost = unconfirmed_page(error), error
        information = achievable_rate(page.phase[data], page.concentration[data], symbols[data], levels)
        judged.append(JudgedPage(information, lost, _drifted(page)))
    return judged


def _drifted(page: DecodedPage) -> bool:
    if page.image is None or page.residual_rad >= DRIFTED_RAD or abs(page.stroke_relative) >= DRIFTED_STROKE:
        return True
    return math.hypot(page.image.shift_x_px, page.image.shift_y_px) >= DRIFTED_PX


def judge(
    before: Sequence[JudgedPage], after: Sequence[JudgedPage], levels: int, subject: str = "re-fitted geometry"
) -> Verdict:
    """Compare two models on the same held-back pages.

    Each page must show its symbols to the new one, whatever the others do. All together must show it no less than the
    standard error below what they show the model in service. Where that one had no drift to follow, they must show
    `GAIN_ERRORS` more than it: else nothing would be gained, and sessions and baselines would begin anew.

    Args:
        before: the pages as the model in service reads them.
        after: the same pages as the new one reads them.
        levels: M of their symbols.
        subject: what is judged.

    Raises:
        RecalibrationRefusedError: the new one is not good enough.
    """
    for page in after:
        if isinstance(page.lost, FrameError):
            raise RecalibrationRefusedError(page.lost.subject, page.lost.got, page.lost.expected)
    least, worst = MIN_AIR_SHARE * math.log2(levels), min(page.air for page in after)
    if not worst >= least:
        raise RecalibrationRefusedError(
            subject,
            f"an AIR of {worst:.3f} bit/symbol on one of the held-back pages",
            f"at least {least:.3f}: the page does not match its symbols",
        )
    if lost := sum(page.lost is not None for page in after):
        raise RecalibrationRefusedError(
            subject,
            f"{lost} of {len(after)} held-back pages whose pilots do not confirm what is claimed",
            "pages of this device, as its decoder was trained: else calibrate and train anew",
        )
    verdict = _verdict(before, after)
    if not verdict.after >= verdict.limit:
        than, why = ("less", "") if verdict.drifted else ("and twice", "; nothing has drifted: less is no gain")
        raise RecalibrationRefusedError(
            subject,
            f"an AIR of {verdict.after:.4f} bit/symbol on held-back pages",
            f"at least {verdict.limit:.4f}: the {verdict.before:.4f} of the model in service {than} the standard error "
            f"of the difference, {verdict.error:.4f}{why}",
        )
    return verdict


def _verdict(before: Sequence[JudgedPage], after: Sequence[JudgedPage]) -> Verdict:
    """The figures of pages that were judged."""
    old = np.concatenate([np.zeros_like(page.information) if page.lost else page.information for page in before])
    new = np.concatenate([page.information for page in after])
    # Where all symbols are read well, one more might not have been: that bit among all of them counts too.
    error = math.hypot(float(np.std(new - old)) / math.sqrt(new.size), 1 / new.size)
    drifted = any(page.drifted or page.lost is not None for page in before)
    return Verdict(float(old.mean()), float(new.mean()), error, drifted)
