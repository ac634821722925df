"""Decoded pages as a codec takes them: pages drawn anew to choose a code by, and pages of a file to read back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.choose import HEADROOM, Choice, DrawnPage, choose
from lightpage.metrics.information import achievable_rate
from lightpage.page.levels import Levels
from lightpage.page.pilots import Pilots, remove_piston
from lightpage.page.symbols import symbol_phases
from lightpage.progress import warn
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import check_recording, check_symbols, pilots_of, unseen_pages
from lightpage.runtime.archives.recordings.refused import RefusedPage, refusal
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import Tracker

AIR_LEVELS = 256
"""Level count of the AIR: fine enough that it does not bound what a phase carries."""


def phase_errors(page: DecodedPage, symbols: NDArray[np.uint8], levels: int | Levels) -> NDArray[np.float32]:
    """Phase error of each symbol of a page, its smooth part still in it, radians [ny, nx]."""
    return remove_piston(page.phase + page.phase_error - symbol_phases(symbols, levels), 0.0)


def air_bits(page: DecodedPage, symbols: NDArray[np.uint8], data: NDArray[np.bool_], levels: int | Levels) -> float:
    """AIR of a page as delivered, over 256 levels whatever its own count is, bits per data symbol."""
    error = (page.phase - symbol_phases(symbols, levels))[data]
    rates = achievable_rate(error, page.concentration[data], np.zeros(error.shape, np.int64), AIR_LEVELS)
    return float(rates.mean())


def choose_code(
    decoder: Decoder, recording: Recording, tracker: Tracker, headroom: float = HEADROOM
) -> tuple[Choice, list[Choice]]:
    """Choose a code by the pages of a recording that the bundle has not seen.

    Args:
        decoder: of the device.
        recording: with known symbols.
        tracker: follows the device from page to page.
        headroom: see `lightpage.codec.choose.choose`.

    Raises:
        RecordingError: another device's recording, or one without symbols.
        InvalidInputError: too few pages that the bundle has not seen and can decode, or no code carries them.
    """
    check_recording(decoder, recording)
    check_symbols(recording, "choose a code by")
    levels, mask = decoder.bundle.levels(recording.levels), pilots_of(decoder, recording)
    errors: list[NDArray[np.float32]] = []
    concentrations: list[NDArray[np.float32]] = []
    refused: list[RefusedPage] = []
    for page, symbols in unseen_pages(decoder, recording, tracker, "choose a code", refused):
        errors.append(phase_errors(page, symbols, levels))  # a page that is lost to the optics is lost to every code
        concentrations.append(page.concentration)
    if refused:
        lost = refusal(f"recording {recording.path}", refused, recording.pages)
        warn(f"{lost.subject}: {lost.got}; they do not count")
    data = ~mask
    rates = [
        achievable_rate(error[data], kappa[data], np.zeros(int(data.sum()), np.int64), AIR_LEVELS).mean()
        for error, kappa in zip(errors, concentrations, strict=True)
    ]

    def draw(levels: int, rng: np.random.Generator) -> Sequence[DrawnPage]:
        pages = []
        for error, kappa in zip(errors, concentrations, strict=True):
            shown = decoder.bundle.levels(levels)
            symbols = rng.integers(0, levels, mask.shape, dtype=np.int64).astype(np.uint8)
            phase = symbol_phases(symbols, shown) + error
            pilots = Pilots.of_symbols(mask, symbols, shown)
            phase = phase - decoder.phase_refit.error(phase, kappa, shown, pilots)
            pages.append(DrawnPage(phase[data], kappa[data].astype(np.float64), symbols[data], shown))
        return pages

    return choose(draw, float(np.mean(rates)) if rates else 1.0, mask, headroom)
