"""Measuring a decoder on a recording."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording, hash_frames
from runtime.bulk.evaluation import evaluate, was_seen
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from runtime.decoding.tracking import NoTracker
from tests.runtime import toy


def peak_bytes(decoder: Decoder, path: Path) -> int:
    with Recording.open(path) as recording:
        tracemalloc.start()
        try:
            evaluate(decoder, recording, NoTracker(decoder))
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


@pytest.mark.parametrize("trained", [("u1", "u1"), ("u2", "u2"), ("u1", "u2")])
@pytest.mark.parametrize("saved", [("u1", "u1"), ("u2", "u2"), (">u2", "u1")])
def test_a_page_is_known_again_in_whichever_type_its_counts_are_stored(
    trained: tuple[str, str], saved: tuple[str, str], tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 256, (2, *toy.SHAPE))
    then, now = (FramePair(counts[0].astype(a), counts[1].astype(b)) for a, b in (trained, saved))
    path = toy.write_toy_bundle(tmp_path / "t.zip", trained_pages=[hash_frames(then)])
    decoder = Decoder(Bundle.open(path), threads=1)
    assert was_seen(decoder, now)
    assert not was_seen(decoder, FramePair(now.quadrature, now.in_phase))
