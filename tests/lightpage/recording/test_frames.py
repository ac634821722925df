"""Frames: those without usable light are named, darkness comes off, hot pixels are mended, odd counts are noticed."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from lightpage.calibration.known_pages import known_pages
from lightpage.errors import BlackFrameError, FrameError, SaturatedFrameError
from lightpage.recording.exposure import check_light, greatest_count, unused_low_bits
from lightpage.recording.pixels.black_level import DarkFrame, PixelRepair, without_black
from lightpage.recording.reader import Recording
from tests.lightpage.refused import refused
from tests.lightpage.small import small_profile


class TestExposure:
    @pytest.mark.parametrize(("count", "kind"), [(5, BlackFrameError), (255, SaturatedFrameError), (256, FrameError)])
    def test_black_saturated_and_too_large_counts_are_named(self, count: int, kind: type[FrameError]) -> None:
        check_light("frame", np.full((4, 5), 100, np.uint16), 8)
        with pytest.raises(FrameError) as caught:
            check_light("frame", np.full((4, 5), count, np.uint16), 8)
        assert (caught.type, caught.value.subject) == (kind, "frame")

    @pytest.mark.parametrize(
        ("dataset", "subject"), [("quadrature", "page 0, quadrature"), ("reference_in_phase", "reference, in-phase")]
    )
    def test_known_pages_without_light_are_named(
        self, small_device: list[str], tmp_path: Path, dataset: str, subject: str
    ) -> None:
        shutil.copy(small_device[small_device.index("--recording") + 1], tmp_path / "R.h5")
        with h5py.File(tmp_path / "R.h5", "r+") as file:
            file[dataset][...] = 0
        with Recording.open(tmp_path / "R.h5") as recording, refused(subject, "black", BlackFrameError):
            known_pages(recording, small_profile(), [0])


def dark(hot: list[tuple[int, int]]) -> np.ndarray:
    frames = np.random.default_rng(0).normal(60, 3, (8, 40, 50))
    for row, column in hot:
        frames[:, row, column] += 900
    return np.rint(frames).astype(np.uint16)


class TestDarkness:
    def test_black_comes_off_and_full_scale_stays(self) -> None:
        frame = np.array([[0, 4, 5, 9, 255]], np.uint8)
        assert without_black(frame, 5, 8).tolist() == [[0, 0, 0, 4, 255]]
        assert without_black(frame, 0, 8) is frame

    def test_hot_pixels_are_found_and_mended(self) -> None:
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

    def test_a_camera_without_hot_pixels_is_left_alone(self) -> None:
        assert len(DarkFrame.of(dark([]), 12).hot) == 0

    def test_a_pixel_without_a_good_neighbour_becomes_black(self) -> None:
        block = np.argwhere(np.ones((3, 3), bool))
        mended = PixelRepair((5, 5), block)(np.full((5, 5), 9, np.uint8))
        assert (mended[0, 0], mended[2, 2]) == (0, 9)

    def test_frames_with_light_are_not_dark(self) -> None:
        for light in (np.random.default_rng(0).integers(0, 255, (4, 30, 30)), np.full((4, 30, 30), 200)):
            with pytest.raises(FrameError):
                DarkFrame.of(light.astype(np.uint8), 8)


PLACE = np.arange(96 * 128).reshape(96, 128)


def counts(bits: int, top: float = 0.9) -> np.ndarray:
    """A frame of right-aligned counts of so many bits."""
    return np.random.default_rng(0).integers(0, int(top * 2**bits), (96, 128), dtype=np.uint16)


class TestAlignment:
    @pytest.mark.parametrize(("bits", "depth"), [(8, 16), (12, 16), (14, 16), (10, 12), (8, 12)])
    def test_left_aligned_counts_are_noticed_and_right_aligned_ones_are_not(self, bits: int, depth: int) -> None:
        assert unused_low_bits(counts(bits) << (depth - bits), depth) == depth - bits
        assert unused_low_bits(counts(depth), depth) == unused_low_bits(counts(bits), depth) == 0

    @pytest.mark.parametrize(
        ("frame", "unused"),
        [
            (np.zeros((96, 128), np.uint16), None),  # few counts do not tell
            (np.full((96, 128), 65520, np.uint16), None),
            (np.where(PLACE % 2, 4096, 0).astype(np.uint16), None),
            (counts(3) << 4, None),  # a dark frame
            (np.maximum(counts(12) << 4, np.uint16(65535) * (PLACE == 389)), 0),  # a digital gain ends at full scale
            (counts(6) << 10, 8),  # a gain that the lower counts need leaves eight bits
        ],
    )
    def test_only_what_tells_is_believed(self, frame: np.ndarray, unused: int | None) -> None:
        assert unused_low_bits(frame, 16) == unused

    def test_saturation_of_left_aligned_counts_is_seen(self) -> None:
        frame = np.minimum(counts(12, top=1.0).astype(int) + 2300, 4095).astype(np.uint16) << 4
        assert greatest_count(16, 4) == 65520
        with refused("frame", "multiples of 16", SaturatedFrameError):
            check_light("frame", frame, 16)
        check_light("frame", counts(12) << 4, 16)
        check_light("frame", counts(16), 16)
