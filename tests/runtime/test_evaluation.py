"""Measuring a decoder on a recording."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np

from optics.recording import Recording
from runtime.decoder import Decoder
from runtime.evaluation import evaluate
from runtime.tracking import NoTracker
from tests.runtime import toy


def peak_bytes(decoder: Decoder, path: Path) -> int:
    with Recording.open(path) as recording:
        tracemalloc.start()
        try:
            evaluate(decoder, recording, NoTracker())
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()


def test_memory_hardly_grows_with_the_recording(decoder: Decoder, tmp_path: Path) -> None:
    few, many = 20, 120
    for pages in (few, many):
        toy.write_toy_recording(tmp_path / f"{pages}.h5", toy.ToyDevice(), 16, pages)
    peak_bytes(decoder, tmp_path / f"{few}.h5")
    grown = peak_bytes(decoder, tmp_path / f"{many}.h5") - peak_bytes(decoder, tmp_path / f"{few}.h5")
    symbols = (many - few) * int(np.count_nonzero(~decoder.bundle.pilot_mask))
    # twelve bytes a symbol, and figures and timings of each page, which weigh most on pages as small as these
    assert grown < 20 * symbols
