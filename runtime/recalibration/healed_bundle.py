"""Recalibrates by pages that a model has lost: heals it, and writes what was found as a bundle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lightpage.errors import RecalibrationRefusedError
from lightpage.progress import Progress
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.recalibration.healing import LostPages, heal
from lightpage.runtime.recalibration.known_pages import MIN_PAGES, KnownPages
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, Refit, RefitResult, recalibrate

_HEALING_SHARE = 0.8
"""Of the time that it takes, judging and writing the rest."""


def recalibrate_by_lost(
    decoder: Decoder,
    pages: LostPages,
    out: Path,
    version: str,
    fit: Refit,
    progress: Progress,
    tracker: Tracker | None = None,
) -> RecalibrationOutcome:
    """Heal a model, and write it as a new bundle, judged by pages that came right and were not fitted on.

    Args:
        pages: that the model does not read.
        decoder, out, version, fit, progress, tracker: as for `recalibrate`.

    Raises:
        RecalibrationRefusedError: fewer than two pages came right, or as `heal` and `recalibrate` raise.
        BundleError: as they raise.
    """
    healed = heal(decoder, pages, lambda what, share: progress(what, _HEALING_SHARE * share), fit)
    if (count := len(healed.known.pairs)) < MIN_PAGES:
        got = f"{count} page that came right after {healed.rounds} rounds"
        raise RecalibrationRefusedError("healing", got, f"at least {MIN_PAGES}: one to fit, one to judge by")

    def judging(what: str, share: float) -> None:
        progress(what, _HEALING_SHARE + (1 - _HEALING_SHARE) * share)

    def fitted(bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> RefitResult:
        return healed.result

    outcome = recalibrate(decoder, healed.known, out, version, fitted, judging, tracker)
    return replace(outcome, seconds=outcome.seconds + healed.seconds)
