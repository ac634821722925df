"""A page travels from the modulator through light, trigger and packets to its symbols."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from lightpage.device.state import Device
from lightpage.errors import Reason, SourceError
from lightpage.page.symbols import random_symbols
from lightpage.recording.pages import PagesWriter
from lightpage.runtime.device.acquisition.camera_source import CameraSource
from lightpage.runtime.device.acquisition.source import open_source
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import TrueOptics
from lightpage.virtual_device.device import VirtualDevice
from tests.lightpage.small import small_profile
from tests.runtime.device.acquisition.lab import reason_of

pytestmark = pytest.mark.own_network

PROFILE = small_profile()
SEED = 5
WAIT_S = 120.0


@pytest.fixture
def symbols(tmp_path: Path) -> np.ndarray:
    """Pages of the device."""
    made = random_symbols(PROFILE, 16, 2, np.random.default_rng(3))
    with PagesWriter(tmp_path / "pages.h5", PROFILE, 16, {}) as writer:
        writer.append(made)
    return made


@contextmanager
def opened(hardware: VirtualDevice, old: str, new: str) -> Iterator[CameraSource]:
    """A device, and something that its configuration says changed."""
    hardware.config.write_text(hardware.config.read_text().replace(old, new))
    with open_source(f"camera:{hardware.config}?pages={hardware.folder / 'pages.h5'}") as source:
        assert isinstance(source, CameraSource)
        yield source


def test_pages_arrive_as_the_simulator_makes_them_with_the_black_level_and_hot_pixels_taken_off(
    tmp_path: Path, symbols: np.ndarray
) -> None:
    clean = Device().with_settings(["sensor.bit_depth=12"])
    expected, device = Simulator(PROFILE, clean, 16, SEED), clean.with_settings(["sensor.hot_pixel_share=6e-5"])
    pairs = [expected.page(page) for page in symbols]  # not beside the device's own: BLAS would share its threads
    hot = [blemishes.hot for blemishes in TrueOptics(PROFILE, device).blemishes]
    sensor = {"pixel_format": "Mono12Packed", "black_level": 6}
    many = "repeats = 50\nreference_frames = 2\ndark_frames = 2"
    with VirtualDevice(PROFILE, device, tmp_path, SEED, **sensor) as hardware:  # type: ignore[arg-type]
        with opened(hardware, "repeats = 3", many) as source:
            source.check_against(PROFILE)
            assert (source.bit_depth, source.levels) == (12, 16)
            dark, _ = source.dark_frames()
            assert dark.black_level == 6
            assert np.array_equal(dark.hot, np.argwhere(hot[0]))
            free = ~np.logical_or(*hot)
            edge, missed = hardware.wire, [1]
            hardware.wire = lambda camera: missed.clear() if camera in missed else edge(camera)
            for page in (0, 1):
                shot, pair = source.shot(WAIT_S), pairs[page]
                assert shot.page_index == page
                assert shot.symbols is not None
                assert (shot.symbols == symbols[page]).all()
                for seen, made in ((shot.pair.in_phase, pair.in_phase), (shot.pair.quadrature, pair.quadrature)):
                    below = free & (made < 4095 - 6)  # full scale, with the black level, keeps its value
                    np.testing.assert_array_equal(seen[below], made[below])
                away = np.abs(shot.pair.in_phase.astype(int) - pair.in_phase)
                assert np.median(away[hot[0]]) < 1000
            assert source.shots_by_outcome()["MISSING_FRAME"] >= 1
            references = source.references()
            assert (references.in_phase[free] == expected.references().in_phase[free]).all()
        hardware.check()


def test_channels_that_no_camera_is_on_and_a_device_that_does_not_run_are_named(
    tmp_path: Path, symbols: np.ndarray
) -> None:
    with VirtualDevice(PROFILE, Device(), tmp_path, SEED) as hardware, opened(hardware, "[1, 2]", "[3, 4]") as source:
        assert reason_of(lambda: source.shot(WAIT_S)) is Reason.MISSING_FRAME
    with pytest.raises(SourceError, match=r"modulator\.sock"), opened(hardware, "", "") as source:
        source.arm()
