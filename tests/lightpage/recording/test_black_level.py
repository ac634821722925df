"""The dark level comes off, and hot pixels are mended from their neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from lightpage.errors import FrameError
from lightpage.recording.black_level import DarkFrame, PixelRepair, without_black


def test_black_comes_off_and_full_scale_stays() -> None:
    frame = np.array([[0, 4, 5, 9, 255]], np.uint8)
    assert without_black(frame, 5, 8).tolist() == [[0, 0, 0, 4, 255]]
    assert without_black(frame, 0, 8) is frame


def dark(hot: list[tuple[int, int]], bits: int = 12) -> np.ndarray:
    rng = np.random.default_rng(0)
    frames = rng.normal(60, 3, (8, 40, 50))
    for row, column in hot:
        frames[:, row, column] += 900
    return np.clip(np.rint(frames), 0, 2**bits - 1).astype(np.uint16)


def test_hot_pixels_are_found_and_mended() -> None:
    places = [(0, 0), (20, 31), (20, 32), (39, 49)]
    found = DarkFrame.of(dark(places), 12)
    assert [tuple(map(int, place)) for place in found.hot] == places
    assert found.black_level == 60
    smooth = np.add.outer(np.arange(40), np.arange(50)).astype(np.uint16) * 10
    spoilt = smooth.copy()
    spoilt[tuple(found.hot.T)] = 4095
    mended = PixelRepair(smooth.shape, found.hot)(spoilt)
    assert int(np.abs(mended.astype(int) - smooth).max()) <= 20
    assert (spoilt[tuple(found.hot.T)] == 4095).all()


def test_a_camera_without_hot_pixels_is_left_alone() -> None:
    found = DarkFrame.of(dark([]), 12)
    assert len(found.hot) == 0
    frame = np.zeros((40, 50), np.uint16)
    assert PixelRepair(frame.shape, found.hot)(frame) is frame


def test_a_pixel_without_a_good_neighbour_becomes_black() -> None:
    block = np.argwhere(np.ones((3, 3), bool))
    mended = PixelRepair((5, 5), block)(np.full((5, 5), 9, np.uint8))
    assert mended[1, 1] in (0, 9)
    assert mended[0, 0] == 0
    assert mended[2, 2] == 9


def test_frames_with_light_are_not_dark() -> None:
    for light in (np.random.default_rng(0).integers(0, 255, (4, 30, 30)), np.full((4, 30, 30), 200)):
        with pytest.raises(FrameError):
            DarkFrame.of(light.astype(np.uint8), 8)
