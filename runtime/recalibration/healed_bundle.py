"""Recalibrates by pages that a model has lost, or by recorded ones: heals it, and writes what was found as a bundle."""

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path

from lightpage.calibration.document import parse_calibration
from lightpage.calibration.known_pages import first_lit_pages, lit_pages
from lightpage.codec.code import Code
from lightpage.errors import CalibrationError, RecalibrationRefusedError, raised_as
from lightpage.progress import Progress, warn
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.recalibration.healing import TOGETHER, LostPages, heal
from lightpage.runtime.recalibration.known_pages import MIN_PAGES, KnownPages, read_recorded
from lightpage.runtime.recalibration.other_device import MOST_PAGES, of_other_device
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, Refit, RefitResult, recalibrate
from lightpage.runtime.recalibration.refit import check_as_good

_HEALING_SHARE = 0.8
"""Of the time that it takes, judging and writing the rest."""
_SEARCH_SHARE = 0.3
"""Of the time, where another device is looked for first."""


def recalibrate_by_lost(
    decoder: Decoder,
    pages: LostPages,
    out: Path,
    version: str,
    fit: Refit,
    progress: Progress,
    tracker: Tracker | None = None,
    start: Decoder | None = None,
) -> RecalibrationOutcome:
    """Heal a model, and write it as a new bundle, judged by pages that came right and were not fitted on.

    Args:
        pages: pages that the model does not read.
        decoder, out, version, fit, progress, tracker: as for `recalibrate`.
        start: the model that is healed, if not `decoder` itself.

    Raises:
        RecalibrationRefusedError: no page came right beside those that were fitted, the geometry that was found is
            wrong where the earlier one was not, or as `heal` and `recalibrate` raise.
        BundleError: as they raise.
    """
    healed = heal(start or decoder, pages, lambda what, share: progress(what, _HEALING_SHARE * share), fit)
    if (count := len(healed.known.pairs)) < max(MIN_PAGES, healed.known.fitted_count + 1):
        got = f"{count} pages that came right after {healed.rounds} rounds, {healed.known.fitted_count} of them fitted"
        raise RecalibrationRefusedError("healing", got, f"at least {MIN_PAGES}, and one that was not, to judge by")
    if (found := healed.decoder.bundle.calibration).is_wrong:
        with raised_as(RecalibrationRefusedError, CalibrationError):
            check_as_good((start or decoder).bundle.calibration, found)

    def judging(what: str, share: float) -> None:
        progress(what, _HEALING_SHARE + (1 - _HEALING_SHARE) * share)

    def fitted(bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> RefitResult:
        return healed.result if start is None else _first_of_its_device(healed.result)

    outcome = recalibrate(decoder, healed.known, out, version, fitted, judging, tracker)
    return replace(outcome, seconds=outcome.seconds + healed.seconds, rounds=healed.rounds)


def _first_of_its_device(result: RefitResult) -> RefitResult:
    """A fit by whose coherence later ones are measured."""
    calibration = parse_calibration(result.calibration_toml).model_copy(update={"coherence_at_first": None})
    return replace(result, calibration_toml=calibration.to_toml())


def recalibrate_by_recording(
    decoder: Decoder,
    recording: Recording,
    count: int,
    code: Callable[[], Code],
    out: Path,
    version: str,
    fit: Refit,
    progress: Progress,
    *,
    other_device: bool = False,
) -> RecalibrationOutcome:
    """Recalibrate by the first recorded pages that show light.

    Args:
        recording: recording of pages with their symbols, or else of user data.
        count: pages with symbols that are taken; of others `TOGETHER` are.
        code: gives that of user data.
        decoder, out, version, fit, progress: as for `recalibrate`.
        other_device: whether the recording is of another device than the bundle's, which no one has calibrated: its
            pages are of user data, and symbols that it may hold are not looked at.

    Raises:
        RecordingError: unreadable.
        RecalibrationRefusedError, BundleError, FrameError, InvalidInputError, PageError: as `recalibrate` and
            `recalibrate_by_lost` raise, or `code`.
    """
    if recording.has_symbols and not other_device:
        known = read_recorded(recording, first_lit_pages(recording, count, warn))
        return recalibrate(decoder, known, out, version, fit, progress)
    own, bits = code(), recording.bit_depth
    most = MOST_PAGES if other_device else TOGETHER
    pairs = tuple(narrow(frames, bits) for _, frames in islice(lit_pages(recording, warn), most))
    lost = LostPages(pairs, own, references=narrow(recording.references(), bits))
    if not other_device:
        return recalibrate_by_lost(decoder, lost, out, version, fit, progress)
    start = of_other_device(decoder, lost, lambda what, share: progress(what, _SEARCH_SHARE * share))

    def behind(what: str, share: float) -> None:
        progress(what, _SEARCH_SHARE + (1 - _SEARCH_SHARE) * share)

    return recalibrate_by_lost(decoder, lost, out, version, fit, behind, start=start)
