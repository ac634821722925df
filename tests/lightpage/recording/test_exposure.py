"""Frames without usable light are named before anything is computed from them."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from lightpage.calibration.known_pages import known_pages
from lightpage.cli.simulate import simulate
from lightpage.errors import FrameError
from lightpage.recording.exposure import check_light
from lightpage.recording.reader import Recording
from tests.lightpage.small import small_profile


def test_black_saturated_and_too_large_counts_are_named() -> None:
    usable = np.full((4, 5), 100, np.uint16)
    check_light("frame", usable, 8)
    with pytest.raises(FrameError, match="frame: got black"):
        check_light("frame", usable * 0 + 5, 8)
    with pytest.raises(FrameError, match=r"saturated: 100\.0%"):
        check_light("frame", usable * 0 + 255, 8)
    with pytest.raises(FrameError, match="a count of 256"):
        check_light("frame", usable * 0 + 256, 8)


@pytest.mark.parametrize(
    ("dataset", "words"),
    [("quadrature", "page 0, quadrature frame"), ("reference_in_phase", "reference, in-phase frame")],
)
def test_known_pages_without_light_are_named(tmp_path: Path, dataset: str, words: str) -> None:
    profile = small_profile()
    (tmp_path / "small.toml").write_text(profile.to_toml())
    made = f"--profile {tmp_path}/small.toml --pages 1 --out {tmp_path}/R.h5"
    CliRunner().invoke(simulate, made.split(), standalone_mode=False, catch_exceptions=False)
    with h5py.File(tmp_path / "R.h5", "r+") as file:
        file[dataset][...] = 0
    with Recording.open(tmp_path / "R.h5") as recording, pytest.raises(FrameError, match=f"{words}: got black"):
        known_pages(recording, profile, [0])
