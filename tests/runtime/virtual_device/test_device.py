"""A page travels from the modulator through light, trigger and packets to its symbols; what goes wrong on the way is
named, and costs no other page."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.page.symbols import random_symbols
from lightpage.recording.pages import PagesWriter
from lightpage.simulator.simulator import Simulator
from runtime.acquisition.camera_source import CameraSource
from runtime.acquisition.sources import open_source
from runtime.bundle.shipped import bundle_path
from runtime.decoding.decoder import Decoder
from runtime.decoding.tracking import confirmed
from runtime.errors import LostShotError, Reason, SourceError
from runtime.virtual_device.device import VirtualDevice
from tests.lightpage.small import small_profile

pytestmark = pytest.mark.own_network

PAGES = 4


def written(profile: Profile, path: Path, levels: int = 16) -> np.ndarray:
    symbols = random_symbols(profile, levels, PAGES, np.random.default_rng(3))
    with PagesWriter(path, profile, levels, {}) as writer:
        writer.append(symbols)
    return symbols


@contextmanager
def running(
    folder: Path, profile: Profile, device: Device, **settings: object
) -> Iterator[tuple[VirtualDevice, CameraSource]]:
    with VirtualDevice(profile, device, folder, seed=5, **settings) as hardware:  # type: ignore[arg-type]
        source = open_source(f"camera:{hardware.config}?pages={folder / 'pages.h5'}")
        assert isinstance(source, CameraSource)
        with source:
            yield hardware, source
        hardware.check()


@pytest.mark.parametrize(("pixel_format", "bits"), [("Mono8", 8), ("Mono12Packed", 12)])
def test_pages_arrive_as_the_simulator_makes_them(tmp_path: Path, pixel_format: str, bits: int) -> None:
    profile, device = small_profile(), Device().with_settings([f"sensor.bit_depth={bits}"])
    symbols = written(profile, tmp_path / "pages.h5")
    expected = Simulator(profile, device, 16, 5)
    with running(tmp_path, profile, device, pixel_format=pixel_format) as (_, source):
        source.check_against(profile)
        assert source.bit_depth == bits
        for page in range(PAGES):
            shot = source.shot(20.0)
            pair = expected.page(symbols[page])
            assert shot.page_index == page
            assert (shot.pair.in_phase == pair.in_phase).all()
            assert (shot.pair.quadrature == pair.quadrature).all()
            assert shot.symbols is not None
            assert (shot.symbols == symbols[page]).all()
        references = source.references()
        assert (references.in_phase == expected.references().in_phase).all()


def test_dark_frames_are_taken_and_hot_pixels_mended(tmp_path: Path) -> None:
    profile, device = small_profile(), Device()
    symbols = written(profile, tmp_path / "pages.h5")
    expected = Simulator(profile, device, 16, 5).page(symbols[0])
    with running(tmp_path, profile, device, black_level=6, hot_pixels=20) as (_, source):
        dark, _ = source.dark_frames()
        assert (dark.black_level, len(dark.hot)) == (6, 20)
        shot = source.shot(20.0)
        away = np.abs(shot.pair.in_phase.astype(int) - expected.in_phase)
        free = expected.in_phase < 249  # black level and full scale cut off what is brighter
        free[tuple(dark.hot.T)] = False
        assert away[free].max() == 0
        assert np.median(away[tuple(dark.hot.T)]) < 60


def test_a_page_is_read_end_to_end_with_a_missed_trigger_a_lost_packet_and_an_unplugged_line(tmp_path: Path) -> None:
    decoder = Decoder.load(bundle_path("bench"), 1)
    profile = decoder.bundle.profile
    symbols = written(profile, tmp_path / "pages.h5")
    with running(tmp_path, profile, Device()) as (hardware, source):
        edge, missed = hardware.wire, [True]

        def missing(camera: int) -> None:
            if camera == 1 and missed:
                missed.clear()
                return
            edge(camera)

        def decoded(page: int, seconds: float = 20.0) -> float:
            shot = source.shot(seconds, page)
            found = confirmed(decoder.decode(shot.pair, 16))
            return float((found.symbols == symbols[page]).mean())

        assert decoded(0) > 0.9
        hardware.wire = missing
        assert decoded(1) > 0.9
        assert source.shots_by_outcome()["TAKEN"] == 2
        assert source.shots_by_outcome()["MISSING_FRAME"] >= 1
        hardware.wire = edge

        hardware.cameras[0].lose(0.3)
        with pytest.raises(LostShotError) as raised:
            source.shot(20.0, 2)
        assert raised.value.reason in (Reason.INCOMPLETE_FRAME, Reason.MISSING_FRAME)
        hardware.cameras[0].lose(0.0)
        assert decoded(2) > 0.9

        lost: list[Reason] = []

        def plug(page: int, error: LostShotError) -> None:
            lost.append(error.reason)
            if len(lost) == 2:  # the line was missed, and looked for in vain
                hardware.port.plug()

        hardware.port.unplug()
        source.on_lost = plug
        assert decoded(3, 60.0) > 0.9
        assert lost[:2] == [Reason.TRIGGER_GONE, Reason.TRIGGER_GONE]
        source.on_lost = lambda page, error: None

        hardware.cameras[1].close()
        started = threading.Timer(1.0, hardware.cameras[1].start)
        started.start()
        assert decoded(3, 30.0) > 0.9
        started.join()


def test_channels_that_no_camera_is_on_lose_their_shots_whoever_used_the_device_before(tmp_path: Path) -> None:
    profile = small_profile()
    written(profile, tmp_path / "pages.h5")
    with VirtualDevice(profile, Device(), tmp_path, seed=5) as hardware:
        spec = f"camera:{hardware.config}?pages={tmp_path / 'pages.h5'}"
        with open_source(spec) as source:
            source.shot(20.0)
        hardware.config.write_text(hardware.config.read_text().replace("channels = [1, 2]", "channels = [3, 4]"))
        with open_source(spec) as source, pytest.raises(LostShotError, match="no frame since the start") as raised:
            source.shot(20.0)
        assert raised.value.reason is Reason.MISSING_FRAME


def test_a_device_that_does_not_run_is_named_before_its_cameras_are_looked_for(tmp_path: Path) -> None:
    profile = small_profile()
    with VirtualDevice(profile, Device(), tmp_path) as hardware:
        spec = f"camera:{hardware.config}"
    source = open_source(spec)
    with pytest.raises(SourceError, match=r"modulator\.sock"):
        source.arm()
    source.close()
