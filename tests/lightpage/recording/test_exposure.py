"""Frames without usable light are named before anything is computed from them."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from lightpage.calibration.known_pages import known_pages
from lightpage.errors import BlackFrameError, FrameError, SaturatedFrameError
from lightpage.recording.exposure import check_light
from lightpage.recording.reader import Recording
from tests.lightpage.refused import refused
from tests.lightpage.small import small_profile


def test_black_saturated_and_too_large_counts_are_named() -> None:
    usable = np.full((4, 5), 100, np.uint16)
    check_light("frame", usable, 8)
    for count, kind in ((5, BlackFrameError), (255, SaturatedFrameError), (256, FrameError)):
        with pytest.raises(FrameError) as caught:
            check_light("frame", np.full((4, 5), count, np.uint16), 8)
        assert (caught.type, caught.value.subject) == (kind, "frame")


@pytest.mark.parametrize(
    ("dataset", "subject"), [("quadrature", "page 0, quadrature"), ("reference_in_phase", "reference, in-phase")]
)
def test_known_pages_without_light_are_named(
    small_device: list[str], tmp_path: Path, dataset: str, subject: str
) -> None:
    shutil.copy(small_device[small_device.index("--recording") + 1], tmp_path / "R.h5")
    with h5py.File(tmp_path / "R.h5", "r+") as file:
        file[dataset][...] = 0
    with Recording.open(tmp_path / "R.h5") as recording, refused(subject, "black", BlackFrameError):
        known_pages(recording, small_profile(), [0])
