"""Pages that are read while others are decoded: each in its place, one ahead, its error with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import RecordingError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from runtime.bulk.frames_ahead import frames_ahead
from tests.runtime.toy import ToyDevice, write_toy_recording


def recorded(folder: Path, pages: int) -> Path:
    """A recording of the toy device."""
    write_toy_recording(folder / "r.h5", ToyDevice(), 16, pages)
    return folder / "r.h5"


def test_every_page_comes_in_its_place_and_one_is_read_ahead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = recorded(tmp_path, 5)
    read: list[int] = []
    with Recording.open(path) as recording:
        expected = [recording.frames(index) for index in range(5)]
        own = recording.frames

        def noted(index: int) -> FramePair:
            read.append(index)
            return own(index)

        monkeypatch.setattr(recording, "frames", noted)
        for index, frames in frames_ahead(recording):
            np.testing.assert_array_equal(frames.result().in_phase, expected[index].in_phase)
            assert max(read) <= index + 1
    assert read == list(range(5))


def test_a_page_that_cannot_be_read_says_so_in_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = recorded(tmp_path, 3)
    with Recording.open(path) as recording:
        own = recording.frames

        def damaged(index: int) -> FramePair:
            if index == 1:
                raise RecordingError("page 1", "damage", "a page")
            return own(index)

        monkeypatch.setattr(recording, "frames", damaged)
        failed = [frames.exception() is not None for _, frames in frames_ahead(recording)]
    assert failed == [False, True, False]


def test_whoever_stops_early_is_not_kept_waiting(tmp_path: Path) -> None:
    path = recorded(tmp_path, 4)
    with Recording.open(path) as recording:
        pages = frames_ahead(recording)
        assert next(pages)[0] == 0
        pages.close()  # type: ignore[attr-defined]
