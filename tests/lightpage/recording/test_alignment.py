"""Counts at the upper end of their bits are noticed, and nothing else is taken for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import SaturatedFrameError
from lightpage.recording.alignment import greatest_count, unused_low_bits
from lightpage.recording.exposure import check_light
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording, RecordingWriter
from tests.lightpage.refused import refused
from tests.lightpage.small import small_profile


def counts(bits: int, seed: int = 0, top: float = 0.9) -> np.ndarray:
    """A frame of right-aligned counts of so many bits."""
    return np.random.default_rng(seed).integers(0, int(top * 2**bits), (96, 128), dtype=np.uint16)


@pytest.mark.parametrize(("bits", "depth"), [(8, 16), (10, 16), (12, 16), (14, 16), (10, 12), (8, 12), (10, 14)])
def test_left_aligned_counts_are_noticed(bits: int, depth: int) -> None:
    assert unused_low_bits(counts(bits) << (depth - bits), depth) == depth - bits


@pytest.mark.parametrize("depth", [8, 10, 12, 14, 16])
def test_right_aligned_counts_are_not(depth: int) -> None:
    assert unused_low_bits(counts(depth), depth) == 0
    assert unused_low_bits(counts(8), depth) == 0


@pytest.mark.parametrize(
    "frame",
    [
        np.zeros((96, 128), np.uint16),
        np.full((96, 128), 65520, np.uint16),
        np.where(np.arange(128) % 2, 4096, 0).astype(np.uint16) * np.ones((96, 1), np.uint16),
        counts(3) << 4,  # a dark frame
    ],
)
def test_few_counts_do_not_tell(frame: np.ndarray) -> None:
    assert unused_low_bits(frame, 16) is None


def test_one_odd_pixel_tells() -> None:
    frame = counts(12) << 4
    frame[3, 5] = 65535  # as of a digital gain, which ends at full scale
    assert unused_low_bits(frame, 16) == 0


def test_a_gain_that_the_lower_counts_need_leaves_eight_bits() -> None:
    assert unused_low_bits(counts(6) << 10, 16) == 8


def test_saturation_of_left_aligned_counts_is_seen() -> None:
    frame = np.minimum(counts(12, top=1.0).astype(int) + 2300, 4095).astype(np.uint16) << 4
    share = (frame == 65520).mean()
    assert share > 0.5
    assert greatest_count(16, 4) == 65520
    with refused("frame", "multiples of 16", SaturatedFrameError):
        check_light("frame", frame, 16)
    check_light("frame", counts(12) << 4, 16)
    check_light("frame", counts(16), 16)


def test_a_recording_of_left_aligned_counts_tells_of_them_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    profile = small_profile()
    frames = [np.random.default_rng(n).integers(0, 4096, profile.frame_shape).astype(np.uint16) << 4 for n in (1, 2)]
    pair = FramePair(frames[0], frames[1])
    symbols = np.zeros(profile.page_shape, np.uint8)
    with RecordingWriter(tmp_path / "R.h5", profile, 16, 16, pair) as writer:
        writer.append(symbols, pair)
    with Recording.open(tmp_path / "R.h5") as recording:
        recording.references()
        recording.frames(0)
    assert [record.message.count("multiples of 16") for record in caplog.records] == [1]
