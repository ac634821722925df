"""Decoded pages as a codec takes them: pages drawn anew to choose a code by, and pages of a file to read back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.choose import FEWEST_PAGES, HEADROOM, Choice, DrawnPage, Drift, choose
from lightpage.metrics.information import achievable_rate
from lightpage.page.levels import Levels
from lightpage.page.pilots import Pilots, remove_piston
from lightpage.page.symbols import symbol_phases
from lightpage.progress import note, warn
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import (
    check_recording,
    check_symbols,
    pilots_of,
    unseen_pages,
)
from lightpage.runtime.archives.recordings.refused import RefusedPage, refusal
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.words import counted

FIRST_CODE_MARGIN = 0.03
"""Share of a page's information that a code keeps in reserve if it is chosen before enough pages were read: pages
differ, and a device drifts from its calibration."""
_DRAWN_PAGES = 8
"""Pages that are drawn by the concentrations of known ones."""
AIR_LEVELS = 256
"""Level count of the AIR: fine enough that it does not bound what a phase carries."""


def phase_errors(page: DecodedPage, symbols: NDArray[np.uint8], levels: int | Levels) -> NDArray[np.float32]:
    """Phase error of each symbol of a page, its smooth part still in it, radians [ny, nx]."""
    return remove_piston(page.phase + page.phase_error - symbol_phases(symbols, levels), 0.0)


def air_bits(page: DecodedPage, symbols: NDArray[np.uint8], data: NDArray[np.bool_], levels: int | Levels) -> float:
    """AIR of a page as delivered, over 256 levels whatever its own count is, bits per data symbol."""
    return float(air_by_symbol(page, symbols, data, levels).mean())


def air_by_symbol(
    page: DecodedPage, symbols: NDArray[np.uint8], data: NDArray[np.bool_], levels: int | Levels
) -> NDArray[np.float64]:
    """Contribution of each data symbol to `air_bits`, bits, 1-D."""
    error = (page.phase - symbol_phases(symbols, levels))[data]
    return achievable_rate(error, page.concentration[data], np.zeros(error.shape, np.int64), AIR_LEVELS)


@dataclass(frozen=True)
class SeenPages:
    """Known pages as a decoder reads them, from which pages of any symbols are drawn.

    Attributes:
        decoder: decoder that read them.
        mask: where their pilots are, [ny, nx].
        errors: see `phase_errors`, a page each.
        concentrations: kappa, [ny, nx], a page each.
    """

    decoder: Decoder
    mask: NDArray[np.bool_]
    errors: Sequence[NDArray[np.float32]]
    concentrations: Sequence[NDArray[np.float32]]

    @classmethod
    def of(
        cls,
        decoder: Decoder,
        recording: Recording,
        pages: Iterable[tuple[DecodedPage, NDArray[np.uint8]]],
    ) -> SeenPages:
        """Take decoded pages of a recording with their symbols."""
        levels = decoder.bundle.levels(recording.levels)
        read = [(phase_errors(page, symbols, levels), page.concentration) for page, symbols in pages]
        errors, concentrations = zip(*read, strict=True) if read else ((), ())
        return cls(decoder, pilots_of(decoder, recording), errors, concentrations)

    def with_pages_of(self, other: SeenPages) -> SeenPages:
        """Return these pages and those of another collection of the same decoder."""
        errors = [*self.errors, *other.errors]
        return replace(self, errors=errors, concentrations=[*self.concentrations, *other.concentrations])

    def drawn_by_concentrations(self, seed: int = 0) -> SeenPages:
        """Draw pages whose phases have the errors that the concentrations of these pages promise (von Mises)."""
        rng = np.random.default_rng(seed)
        concentrations = [self.concentrations[number % len(self.concentrations)] for number in range(_DRAWN_PAGES)]
        errors = [rng.vonmises(0.0, kappa).astype(np.float32) for kappa in concentrations]
        return replace(self, errors=errors, concentrations=concentrations)

    @property
    def air_bits(self) -> float:
        """AIR of the pages, bits a data symbol; 1 where there are none."""
        data = ~self.mask
        rates = [
            achievable_rate(error[data], kappa[data], np.zeros(int(data.sum()), np.int64), AIR_LEVELS).mean()
            for error, kappa in zip(self.errors, self.concentrations, strict=True)
        ]
        return float(np.mean(rates)) if rates else 1.0

    def draw(self, levels: int, rng: np.random.Generator) -> Sequence[DrawnPage]:
        """See `lightpage.codec.choose.Draw`."""
        pages, mask, data = list[DrawnPage](), self.mask, ~self.mask
        shown = self.decoder.bundle.levels(levels)
        for error, kappa in zip(self.errors, self.concentrations, strict=True):
            symbols = rng.integers(0, levels, mask.shape, dtype=np.int64).astype(np.uint8)
            phase = symbol_phases(symbols, shown) + error
            pilots = Pilots.of_symbols(mask, symbols, shown)
            phase = phase - self.decoder.phase_refit.error(phase, kappa, shown, pilots)
            pages.append(DrawnPage(phase[data], kappa[data].astype(np.float64), symbols[data], shown))
        return pages


def choose_code(
    decoder: Decoder, recording: Recording, tracker: Tracker, headroom: float = HEADROOM, drift: Drift | None = None
) -> tuple[Choice, list[Choice]]:
    """Choose a code by the pages of a recording that the bundle has not seen.

    Where the recording has too few, and the bundle reads by maximum likelihood, the code is chosen by the
    concentrations of all pages, those of the calibration included. They follow from the Fisher information.
    `FIRST_CODE_MARGIN` is kept in reserve.

    Args:
        decoder: decoder of the device.
        recording: recording with known symbols.
        tracker: follows the device from page to page.
        headroom, drift: see `lightpage.codec.choose.choose`.

    Raises:
        RecordingError: another device's recording, or one without symbols.
        InvalidInputError: too few pages that the bundle has not seen and can decode, or no code carries them.
    """
    check_recording(decoder, recording)
    check_symbols(recording, "choose a code by")
    refused: list[RefusedPage] = []
    # a page that is lost to the optics is lost to every code
    unseen = SeenPages.of(decoder, recording, unseen_pages(decoder, recording, tracker, "choose a code", refused))
    if refused:
        lost = refusal(f"recording {recording.path}", refused, recording.pages)
        warn(f"{lost.subject}: {lost.got}; they do not count")
    if len(unseen.errors) >= FEWEST_PAGES or refused or not decoder.bundle.is_estimator:
        return choose(unseen.draw, unseen.air_bits, unseen.mask, headroom, drift=drift)
    calibrated = unseen_pages(decoder, recording, tracker.anew(), "choose a first code", refused, in_sample=True)
    pages = SeenPages.of(decoder, recording, calibrated).with_pages_of(unseen)
    if not pages.errors:
        return choose(unseen.draw, unseen.air_bits, unseen.mask, headroom, drift=drift)
    note(
        f"code: chosen by the Fisher information of {counted(len(pages.errors), 'page')}, with {FIRST_CODE_MARGIN:.0%} "
        f"in reserve; {FEWEST_PAGES} pages that the calibration has not seen allow a better one (lightpage code)"
    )
    drawn = pages.drawn_by_concentrations()
    return choose(drawn.draw, drawn.air_bits, drawn.mask, headroom, drift=drift, margin=FIRST_CODE_MARGIN)
