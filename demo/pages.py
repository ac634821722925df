"""The pages of the demo: a picture as a file, encoded in groups, and one page spoilt."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.volume import Volume, encode_volume
from lightpage.recording.pages import PagesWriter
from lightpage.runtime.model.decoding.decoder import Decoder

GROUPS = 2
PARITY_PAGES = 2
SPOILT_PAGE = 1
"""Page whose symbols are damaged, of those that are written."""
SPOILT_SHARE = 0.4
"""Spoilt share of its symbols: far more than its code mends."""


def write_pages(decoder: Decoder, grey: NDArray[np.uint8], path: Path, seed: int) -> Volume:
    """Put a grey picture [rows, columns] on pages in `path`, one of them spoilt; returns how it lies there.

    Raises:
        BundleError: the bundle has no code.
    """
    codec, content = decoder.page_codec, pgm(grey)
    data = -(-len(content) // codec.user_bytes)
    volume = Volume.of_file(io.BytesIO(content), 1 + seed, codec.user_bytes, -(-data // GROUPS), PARITY_PAGES)
    profile, levels = decoder.bundle.profile, codec.code.levels
    rng = np.random.default_rng(seed)
    count = 0
    with PagesWriter(path, profile, levels, codec.code.model_dump() | volume.to_json()) as writer:
        for symbols in encode_volume(codec, volume, io.BytesIO(content), decoder.bundle.written_pilots(levels)):
            if count <= SPOILT_PAGE < count + len(symbols):
                spoilt = symbols[SPOILT_PAGE - count]
                damage = (rng.random(spoilt.shape) < SPOILT_SHARE) & ~codec.pilots
                spoilt[damage] = rng.integers(0, levels, int(damage.sum()))
            writer.append(symbols)
            count += len(symbols)
    return volume


def pgm(grey: NDArray[np.uint8]) -> bytes:
    """A grey picture [rows, columns] as a file in the portable graymap format."""
    rows, columns = grey.shape
    return f"P5 {columns} {rows} 255\n".encode() + grey.tobytes()
