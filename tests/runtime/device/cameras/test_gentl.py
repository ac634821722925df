"""A camera behind a GenTL producer: TLSimu of genicam, whose pictures are ramps that move by one with a frame."""

import os
import signal
from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import Reason, SourceError
from lightpage.runtime.device.cameras.camera import Camera, Frame
from lightpage.runtime.device.cameras.gentl import GenTLCamera
from lightpage.runtime.device.cameras.settings import CameraSettings
from tests.processes import children, runs
from tests.runtime.device.acquisition.lab import reason_of
from tests.waiting import eventually

_SPEC = find_spec("genicam")
PRODUCER = Path(_SPEC.origin or "").parent / "TLSimu.cti" if _SPEC else Path("TLSimu.cti")
SHAPE = (48, 64)
WAIT_S = 30.0

pytestmark = pytest.mark.skipif(
    not PRODUCER.is_file() and not os.environ.get("LIGHTPAGE_REQUIRE_ALL"),
    reason="genicam 1.5.0 with TLSimu.cti is not installed",
)


def made(shape: tuple[int, int] = SHAPE, **changes: object) -> GenTLCamera:
    given = {"driver": "gentl", "producer": str(PRODUCER), "serial": "SN_InterfaceB_0", "trigger_source": "Software"}
    return GenTLCamera(CameraSettings.model_validate({**given, **changes}), shape, "in-phase camera")


@pytest.fixture
def camera() -> Iterator[GenTLCamera]:
    with closing(made()) as camera:
        yield camera


def taken(camera: Camera) -> Frame:
    """The next frame, which must be the picture that TLSimu makes under its number."""
    camera.fire()
    frame = camera.frame(WAIT_S)
    assert isinstance(frame, Frame), frame
    expected = (np.indices(SHAPE).sum(0) + frame.info.frame_id).astype(np.uint8)
    assert frame.pixels.dtype == np.uint8
    assert (frame.pixels == expected).all()
    return frame


def its_process() -> int:
    """The process of the only camera."""
    (process,) = eventually(lambda: children(os.getpid(), "lightpage.runtime.device.cameras.gentl_process"))
    return process


def test_frames_arrive_to_the_byte_one_for_each_trigger(camera: GenTLCamera) -> None:
    with pytest.raises(SourceError):
        camera.fire()
    camera.arm()
    assert camera.frame(0.0) is None
    infos = [taken(camera).info for _ in range(4)]
    assert camera.frame(0.05) is None
    assert (infos[0].serial, infos[0].pixel_format) == ("SN_InterfaceB_0", "Mono8")
    assert infos[0].exposure_s is None  # TLSimu knows none
    assert 1.7e9 < infos[0].host_time_s < 1e10  # since 1970
    assert np.diff([info.frame_id for info in infos]).tolist() == [1, 1, 1]
    assert (camera.frame_numbers, camera.bit_depth, camera.opened) == (2**64 - 1, 8, 1)


def test_arming_anew_drops_what_waits_and_a_camera_that_is_disarmed_takes_nothing(camera: GenTLCamera) -> None:
    camera.arm()
    for _ in range(3):
        camera.fire()
    camera.arm()
    assert camera.frame(0.1) is None
    taken(camera)
    camera.disarm()
    with pytest.raises(SourceError):
        camera.frame(0.0)
    camera.arm()
    taken(camera)
    assert camera.opened == 1


def test_a_process_that_dies_is_a_camera_that_went_away_and_comes_back(camera: GenTLCamera) -> None:
    camera.arm()
    os.kill(its_process(), signal.SIGKILL)
    assert reason_of(lambda: camera.frame(1.0)) is Reason.CAMERA_GONE
    camera.arm()
    taken(camera)
    assert camera.opened == 2
    process = its_process()
    camera.close()
    assert not runs(process)
    assert reason_of(lambda: camera.frame(0.0)) is Reason.CAMERA_GONE


def test_a_process_that_hangs_is_given_up(camera: GenTLCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    camera.arm()
    monkeypatch.setattr("lightpage.runtime.device.cameras.gentl.COMMAND_S", 0.05)
    hung = its_process()
    os.kill(hung, signal.SIGSTOP)
    assert reason_of(lambda: camera.frame(0.1)) is Reason.CAMERA_GONE
    assert not runs(hung)


@pytest.mark.parametrize(
    ("changes", "shape", "setting", "told"),
    [
        ({"serial": "B4711"}, SHAPE, "serial", "SN_InterfaceB_0"),
        ({"producer": "/nowhere/maker.cti"}, SHAPE, "producer", "/nowhere/maker.cti"),
        ({"trigger_source": "Line0"}, SHAPE, "trigger_source", "Software"),
        ({"exposure_us": 100}, SHAPE, "exposure_us", "100.0"),
        ({"offset_x_px": 8}, SHAPE, "offset_x_px", "8"),
        ({"pixel_format": "Mono12"}, SHAPE, "PayloadSize", "6144"),
        ({}, (48, 63), "columns", "63"),
    ],
)
def test_what_it_does_not_take_is_named(
    changes: dict[str, object], shape: tuple[int, int], setting: str, told: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with closing(made(shape, **changes)) as camera, pytest.raises(SourceError) as raised:
        camera.arm()
    assert raised.value.subject.partition(": ")[2].startswith(setting)
    assert told in f"{raised.value.got} {raised.value.expected}"
    assert capfd.readouterr().err == ""  # its error says all of it
