"""Whether a re-fitted model is as good as the one in service."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean

from lightpage.errors import FrameError, RecalibrationRefusedError
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from runtime.bundle.bundle import Bundle
from runtime.decoding.tracking import Tracker, unconfirmed_page
from runtime.errors import LostPageError, UnconfirmedPageError
from runtime.recalibration.known_pages import KnownPages

MIN_AIR_SHARE = 0.02
"""Share of log2 M below which a held-back page does not match its symbols at all: wrong pilots, wrong device."""

TOLERATED_LOSS_BITS = 0.01
"""AIR that a re-fit may lose to the noise of a few held-back pages and still replace an equally good model."""


@dataclass(frozen=True)
class JudgedPage:
    """A held-back page: its AIR over the data symbols, bits per symbol, and why it would not have been given out."""

    air: float
    lost: LostPageError | FrameError | None = None


def judged_pages(
    tracker: Tracker, bundle: Bundle, pages: KnownPages, progress: Callable[[float], None]
) -> list[JudgedPage]:
    """The pages, as a service reads them with this tracker."""
    mask = bundle.pilot_mask if pages.pilot_mask is None else pages.pilot_mask
    data, judged = ~mask, list[JudgedPage]()
    for pair, symbols in zip(pages.pairs, pages.symbols, strict=True):
        progress(len(judged) / len(pages.pairs))
        lost = None
        try:
            page = tracker.decode(pair, pages.levels, Pilots.of_symbols(mask, symbols, pages.levels))
        except FrameError as error:
            judged.append(JudgedPage(0.0, error))
            continue
        except UnconfirmedPageError as error:
            page, lost = unconfirmed_page(error), error
        figures = measure(page.phase[data], page.concentration[data], symbols[data], pages.levels)
        judged.append(JudgedPage(figures.air_bits_per_symbol, lost))
    return judged


def judge(before: float, judged: list[JudgedPage], levels: int, subject: str = "re-fitted geometry") -> None:
    """Each page must show its symbols, whatever the others do, and all together more of them than before.

    Args:
        before: AIR of the model in service, bits per symbol.
        judged: pages as the new one reads them.
        levels: M of their symbols.
        subject: what is judged.

    Raises:
        RecalibrationRefusedError: they do not.
    """
    for page in judged:
        if isinstance(page.lost, FrameError):
            raise RecalibrationRefusedError(page.lost.subject, page.lost.got, page.lost.expected)
    least, worst, after = (
        MIN_AIR_SHARE * math.log2(levels),
        min(page.air for page in judged),
        fmean(p.air for p in judged),
    )
    if not worst >= least:
        raise RecalibrationRefusedError(
            subject,
            f"an AIR of {worst:.3f} bit/symbol on one of the held-back pages",
            f"at least {least:.3f}: the page does not match its symbols",
        )
    if lost := sum(page.lost is not None for page in judged):
        raise RecalibrationRefusedError(
            subject,
            f"{lost} of {len(judged)} held-back pages whose pilots do not confirm what is claimed",
            "pages of this device, as its decoder was trained: else calibrate and train anew",
        )
    if after < before - TOLERATED_LOSS_BITS:
        raise RecalibrationRefusedError(
            subject,
            f"an AIR of {after:.3f} bit/symbol on held-back pages",
            f"at least the {before:.3f} of the model in service",
        )
