"""A page travels from the modulator through light, trigger and packets to its symbols; what goes wrong on the way is
named, and costs no other page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from lightpage.device.state import Device
from lightpage.page.symbols import random_symbols
from lightpage.recording.pages import PagesWriter
from lightpage.simulator.simulator import Simulator
from runtime.acquisition.camera_source import CameraSource
from runtime.acquisition.sources import open_source
from runtime.errors import LostShotError, Reason, SourceError
from runtime.virtual_device.device import VirtualDevice
from tests.lightpage.small import small_profile

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


@contextmanager
def running(folder: Path, device: Device, **settings: object) -> Iterator[tuple[VirtualDevice, CameraSource]]:
    with VirtualDevice(PROFILE, device, folder, SEED, **settings) as hardware:  # type: ignore[arg-type]
        with opened(hardware, "repeats = 3", "repeats = 50\nreference_frames = 2\ndark_frames = 2") as source:
            yield hardware, source
        hardware.check()


def test_pages_arrive_as_the_simulator_makes_them_with_the_black_level_and_hot_pixels_taken_off(
    tmp_path: Path, symbols: np.ndarray
) -> None:
    device = Device().with_settings(["sensor.bit_depth=12"])
    expected = Simulator(PROFILE, device, 16, SEED)
    given = {"pixel_format": "Mono12Packed", "black_level": 6, "hot_pixels": 20}
    with running(tmp_path, device, **given) as (_, source):
        source.check_against(PROFILE)
        assert (source.bit_depth, source.levels) == (12, 16)
        dark, _ = source.dark_frames()
        assert (dark.black_level, len(dark.hot)) == (6, 20)
        free = np.ones(PROFILE.frame_shape, bool)
        free[tuple(dark.hot.T)] = False
        for page in (0, 1):
            shot, pair = source.shot(WAIT_S), expected.page(symbols[page])
            assert shot.page_index == page
            assert shot.symbols is not None
            assert (shot.symbols == symbols[page]).all()
            for seen, made in ((shot.pair.in_phase, pair.in_phase), (shot.pair.quadrature, pair.quadrature)):
                below = free & (made <= 4095 - 6)  # full scale cuts off what is brighter
                assert (seen[below] == made[below]).all()
            away = np.abs(shot.pair.in_phase.astype(int) - pair.in_phase)
            assert np.median(away[~free]) < 1000
        references = source.references()
        assert (references.in_phase[free] == expected.references().in_phase[free]).all()


def test_a_missed_trigger_a_lost_packet_an_unplugged_line_and_a_camera_that_goes_cost_no_page(
    tmp_path: Path, symbols: np.ndarray
) -> None:
    with running(tmp_path, Device()) as (hardware, source):
        edge, missed = hardware.wire, [True]

        def missing(camera: int) -> None:
            if camera == 1 and missed:
                missed.clear()
            else:
                edge(camera)

        def read(page: int) -> bool:
            """Whether a page's shot shows what is on display."""
            pair, seen = source.shot(WAIT_S, page).pair, hardware.light.pair()
            both = ((pair.in_phase, seen.in_phase), (pair.quadrature, seen.quadrature))
            return hardware.light.page_index == page and all((taken == shown).all() for taken, shown in both)

        assert read(0)
        hardware.wire = missing
        assert read(1)
        assert source.shots_by_outcome()["TAKEN"] == 2
        assert source.shots_by_outcome()["MISSING_FRAME"] >= 1
        hardware.wire = edge
        lost: list[Reason] = []

        def mend(page: int, error: LostShotError) -> None:
            lost.append(error.reason)
            if error.reason in faults:
                faults[error.reason][1]()

        faults = {
            Reason.INCOMPLETE_FRAME: (lambda: hardware.cameras[0].lose(0.3), lambda: hardware.cameras[0].lose(0.0)),
            Reason.TRIGGER_GONE: (hardware.port.unplug, hardware.port.plug),
            Reason.CAMERA_GONE: (hardware.cameras[1].close, hardware.cameras[1].start),
        }
        source.on_lost = mend
        for page, (reason, (break_it, _)) in enumerate(faults.items()):
            lost.clear()
            break_it()
            assert read(page % 2)
            assert reason in lost


def test_channels_that_no_camera_is_on_and_a_device_that_does_not_run_are_named(
    tmp_path: Path, symbols: np.ndarray
) -> None:
    with VirtualDevice(PROFILE, Device(), tmp_path, SEED) as hardware:
        with opened(hardware, "[1, 2]", "[3, 4]") as source, pytest.raises(LostShotError) as raised:
            source.shot(WAIT_S)
        assert raised.value.reason is Reason.MISSING_FRAME
    with pytest.raises(SourceError, match=r"modulator\.sock"), opened(hardware, "", "") as source:
        source.arm()
