"""Reads known pages with a calibration: the measurement behind its verdict."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.goodness.verdict import Reading
from lightpage.calibration.likelihood.noise import light_bits
from lightpage.codec.code import Code
from lightpage.codec.page_codec import PageCodec
from lightpage.errors import BlackFrameError, InvalidInputError, LostPageError, SaturatedFrameError
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import air_by_symbol
from lightpage.runtime.archives.recordings.drift import PageState, drift_of, steps_of
from lightpage.runtime.archives.recordings.evaluation import decode_unseen, pilots_of
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for

MOST_READ = 4
"""Largest number of pages that are read: their AIR is known to 0.02 bit on the bench device."""


def reading_of(
    decoder: Decoder, recording: Recording, code: Code | None, progress: Progress = lambda step, share: None
) -> Reading | None:
    """Read pages of a recording that the fit of a bundle has not seen; its own ones where no others are left.

    Args:
        decoder: decoder of the bundle, an estimator by the fitted waves.
        recording: recording of the device.
        code: code of user bytes; None where no code carries the pages.
        progress: called with the finished share of the work.

    Returns:
        What was read; None where no page has known symbols and light.
    """
    mask = pilots_of(decoder, recording)
    rates: list[NDArray[np.float64]] = []
    states: list[PageState] = []
    in_sample = True
    for in_sample in (False, True):
        rates, states = _read(decoder, recording, mask, progress, in_sample=in_sample)
        if rates:
            break
    if not rates:
        return None
    means = np.array([page.mean() for page in rates])
    by_symbols = np.sqrt(np.mean([page.var() / page.size for page in rates]) / len(rates))
    by_pages = means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else 0.0
    goodness = decoder.bundle.calibration.goodness
    frames, modulator = (goodness.frame_error_rad, goodness.modulator_error_rad) if goodness else (None, None)
    information = decoder.graph.value("information")[~mask].astype(np.float64)
    return Reading(
        in_sample=in_sample,
        pages=len(rates),
        air_bits=float(means.mean()),
        air_standard_error_bits=float(max(by_symbols, by_pages)),
        light_bits=light_bits(information, frames or 0.0, modulator or 0.0),
        user_bytes=0 if code is None else PageCodec(code, mask, decoder.bundle.levels(code.levels)).user_bytes,
        drift=steps_of(drift_of(states)),
    )


def _read(
    decoder: Decoder, recording: Recording, mask: NDArray[np.bool_], progress: Progress, *, in_sample: bool
) -> tuple[list[NDArray[np.float64]], list[PageState]]:
    """Read the first pages.

    Returns:
        Contribution of each data symbol to the AIR, bits, of each page; a zero for a page that is refused. State of the
        device on each page that was read.
    """
    tracker = tracker_for(decoder)
    rates: list[NDArray[np.float64]] = []
    states: list[PageState] = []
    for number in range(recording.pages):
        if len(rates) == MOST_READ:
            break
        symbols = recording.symbols(number)
        if symbols is None:
            continue
        progress("read known pages", len(rates) / MOST_READ)
        frames = recording.frames(number)
        try:
            page = decode_unseen(decoder, recording, tracker, mask, frames, symbols, in_sample=in_sample)
        except (BlackFrameError, SaturatedFrameError):
            continue
        except (InvalidInputError, LostPageError):
            rates.append(np.zeros(1))
            continue
        if page is not None:
            rates.append(air_by_symbol(page, symbols, ~mask, decoder.bundle.levels(recording.levels)))
            states.append(PageState.of(page))
    return rates, states
