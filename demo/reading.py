"""The picture as a client of the service reads it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.volume import Volume
from lightpage.codec.volume_file import Restored, VolumeFiles
from lightpage.demo.pages import pgm
from lightpage.demo.result import Phase
from lightpage.errors import InvalidInputError, LostPageError
from lightpage.metrics.information import achievable_rate
from lightpage.page.levels import Levels
from lightpage.runtime.archives.recordings.coded_pages import AIR_LEVELS
from lightpage.runtime.client.answers import RemotePage
from lightpage.runtime.client.client import LightpageClient


def read_picture(
    client: LightpageClient,
    volume: Volume,
    written: NDArray[np.uint8],
    path: Path,
    name: str,
    told: Callable[[float], None],
) -> Phase:
    """Read all pages of a written picture and put it together again, in `path`; what is lost of it is black there."""
    pages: list[RemotePage] = []
    unread = 0
    margins: list[float] = []
    with VolumeFiles(path) as files:
        for number in range(volume.pages):
            told(number / volume.pages)
            try:
                page = client.pages.read(
                    number, user_data=True, want_concentration=True, want_phase=True, want_written=True
                )
            except LostPageError:
                unread += 1
                continue
            pages.append(page)
            if page.user_data is None or page.user_data.data is None:
                unread += 1
                continue
            files.add(page.user_data)
            margins.append(page.user_data.margin_bits)
        file = files.chosen()
        done = Restored((), ()) if file is None else file.restore()
        if file is not None:
            file.complete(done.lost)
    black = np.zeros_like(written)
    if not margins:
        path.write_bytes(pgm(black))
    content, expected = path.read_bytes(), pgm(written)
    grey = np.frombuffer(content[len(expected) - black.size :], np.uint8)
    return replace(
        summarise(name, pages) if pages else _nothing(name, client),
        pages=volume.pages,
        unread=unread,
        restored=len(done.restored),
        lost=len(done.lost) if margins else volume.file_pages,
        margin_bits=min(margins, default=None),
        picture=grey.reshape(black.shape),
        exact=content == expected,
    )


def _nothing(name: str, client: LightpageClient) -> Phase:
    """A state in which no page was decoded."""
    description = client.describe()
    air = np.where(description.pilot_mask, np.nan, 0.0)
    return Phase(name, description.model.version, air, np.zeros(description.page_shape), 1.0, float("nan"))


def summarise(name: str, pages: Sequence[RemotePage]) -> Phase:
    """Figures and maps of decoded pages that come with what was written, phase and concentration."""
    rates, errors = [], []
    for page in pages:
        if page.phase is None or page.concentration is None or page.written is None or page.pilot_mask is None:
            raise InvalidInputError(f"page {page.page}", "symbols alone", "phase, concentration and what was written")
        error = page.phase - Levels(page.levels, page.level_phases).phases[page.written]
        rate = achievable_rate(error, page.concentration, np.zeros_like(page.written), AIR_LEVELS)
        rates.append(np.where(page.pilot_mask, np.nan, rate))
        errors.append((page.symbols != page.written)[~page.pilot_mask])
    return Phase(
        name=name,
        model_version=pages[-1].model_version,
        air=np.mean(rates, axis=0),
        confidence=np.mean([page.confidence for page in pages], axis=0, dtype=np.float64),
        symbol_error_rate=float(np.mean(errors)),
        seconds=float(np.median([page.timings.decode_s for page in pages])),
    )
