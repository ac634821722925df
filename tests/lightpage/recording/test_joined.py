"""Recordings of one device as one: every page is there, in order, and nothing of another kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import RecordingError
from lightpage.recording.joined import join
from lightpage.recording.reader import Recording
from tests.lightpage.refused import refused
from tests.runtime import toy


def test_pages_follow_one_another_and_references_are_the_first_ones(tmp_path: Path) -> None:
    paths = [tmp_path / "b.h5", tmp_path / "a.h5"]
    for number, path in enumerate(paths):
        device = toy.ToyDevice((100.0 + 10 * number, 80.0), seed=number)
        toy.write_toy_recording(path, device, 16, 2 + number, seed=number)
    join(paths, tmp_path / "joined.h5")
    with Recording.open(tmp_path / "joined.h5") as joined:
        shown = [joined.shown(page) for page in range(joined.pages)]
        assert (joined.levels, joined.references().in_phase.mean()) == (16, 100.0)
        stored = joined.stored_page_bytes * joined.pages
    expected = []
    for path in paths:
        with Recording.open(path) as recording:
            stored -= recording.stored_page_bytes * recording.pages
            expected += [recording.shown(page) for page in range(recording.pages)]
    assert len(shown) == len(expected) == 5
    assert stored == pytest.approx(0.0)
    for (pair, symbols), (own_pair, own_symbols) in zip(shown, expected, strict=True):
        np.testing.assert_array_equal(symbols, own_symbols)
        np.testing.assert_array_equal(pair.in_phase, own_pair.in_phase)
        np.testing.assert_array_equal(pair.quadrature, own_pair.quadrature)


def test_what_differs_is_named(tmp_path: Path) -> None:
    for name, levels in (("a", 16), ("b", 8)):
        toy.write_toy_recording(tmp_path / f"{name}.h5", toy.ToyDevice(), levels, 2)
    with refused("b.h5: levels", 8, RecordingError):
        join([tmp_path / "a.h5", tmp_path / "b.h5"], tmp_path / "joined.h5")
