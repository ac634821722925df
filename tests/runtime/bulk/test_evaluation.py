"""Measuring a decoder on a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import hash_frames
from runtime.bulk.evaluation import was_seen
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from tests.runtime import toy


@pytest.mark.parametrize("trained", [("u1", "u1"), ("u1", "u2")])
@pytest.mark.parametrize("saved", [("u2", "u2"), (">u2", "u1")])
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
