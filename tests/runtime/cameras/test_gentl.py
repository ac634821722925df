"""A camera behind a GenTL producer: TLSimu of genicam, whose pictures are ramps that move by one with a frame."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.acquisition.pairing import Pairing
from runtime.cameras.camera import Camera, Frame, FrameStatus
from runtime.cameras.gentl import GenTLCamera
from runtime.cameras.settings import CameraSettings
from runtime.errors import LostShotError, Reason, SourceError
from runtime.trigger.software import SoftwareTrigger

_SPEC = find_spec("genicam")
PRODUCER = Path(_SPEC.origin or "").parent / "TLSimu.cti" if _SPEC else Path("TLSimu.cti")
SHAPE = (48, 64)
WAIT_S = 5.0

pytestmark = pytest.mark.skipif(
    not PRODUCER.is_file() and not os.environ.get("LIGHTPAGE_REQUIRE_ALL"),
    reason="genicam 1.5.0 with TLSimu.cti is not installed",
)


def settings(**changes: object) -> CameraSettings:
    given: dict[str, object] = {
        "driver": "gentl",
        "producer": str(PRODUCER),
        "serial": "SN_InterfaceB_0",
        "trigger_source": "Software",
    }
    return CameraSettings.model_validate({**given, **changes})


@pytest.fixture
def camera() -> Iterator[GenTLCamera]:
    made = GenTLCamera(settings(), SHAPE, "in-phase camera")
    yield made
    made.close()


def taken(camera: Camera) -> Frame:
    camera.fire()
    frame = camera.frame(WAIT_S)
    assert frame is not None
    assert frame.status is FrameStatus.COMPLETE, frame.detail
    return frame


def ramp(frame: Frame) -> NDArray[np.uint8]:
    """The picture that TLSimu makes under this number."""
    assert frame.info is not None
    rows, columns = np.indices(SHAPE)
    return (rows + columns + frame.info.frame_id).astype(np.uint8)


def process_of(camera: GenTLCamera) -> int:
    assert camera._process is not None
    return camera._process._process.pid


def test_frames_arrive_to_the_byte(camera: GenTLCamera) -> None:
    camera.arm()
    frames = [taken(camera) for _ in range(6)]
    for frame in frames:
        assert frame.pixels is not None
        assert frame.info is not None
        assert frame.pixels.dtype == np.uint8
        assert (frame.pixels == ramp(frame)).all()
        assert (frame.info.serial, frame.info.pixel_format) == ("SN_InterfaceB_0", "Mono8")
        assert frame.info.exposure_s is None  # TLSimu knows none
        assert abs(frame.info.host_time_s - time.time()) < 60
    numbers = [frame.info.frame_id for frame in frames if frame.info]
    assert numbers == list(range(numbers[0], numbers[0] + 6))
    assert (camera.frame_numbers, camera.bit_depth, camera.opened) == (2**64 - 1, 8, 1)


def test_nothing_comes_without_a_trigger_and_one_frame_for_each(camera: GenTLCamera) -> None:
    camera.arm()
    assert camera.frame(0.0) is None
    assert camera.frame(0.2) is None
    taken(camera)
    assert camera.frame(0.1) is None


def test_arming_anew_drops_what_waits(camera: GenTLCamera) -> None:
    camera.arm()
    for _ in range(3):
        camera.fire()
    camera.arm()
    assert camera.frame(0.1) is None
    taken(camera)
    assert camera.opened == 1


def test_a_camera_that_is_disarmed_takes_nothing_until_it_is_armed(camera: GenTLCamera) -> None:
    with pytest.raises(SourceError, match="not armed"):
        camera.fire()
    camera.arm()
    camera.disarm()
    with pytest.raises(SourceError, match="not armed"):
        camera.frame(0.0)
    camera.arm()
    taken(camera)


def test_a_process_that_dies_is_a_camera_that_went_away_and_comes_back(camera: GenTLCamera) -> None:
    camera.arm()
    os.kill(process_of(camera), signal.SIGKILL)
    with pytest.raises(LostShotError) as lost:
        camera.frame(1.0)
    assert lost.value.reason is Reason.CAMERA_GONE
    camera.arm()
    taken(camera)
    assert camera.opened == 2


def test_a_process_that_hangs_is_given_up(camera: GenTLCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.cameras.gentl._COMMAND_S", 0.3)
    camera.arm()
    hung = process_of(camera)
    os.kill(hung, signal.SIGSTOP)
    begun = time.monotonic()
    with pytest.raises(LostShotError, match=r"no answer within 0\.4 s"):
        camera.frame(0.1)
    assert time.monotonic() - begun < 8
    with pytest.raises(ProcessLookupError):
        os.kill(hung, 0)


def test_its_process_ends_with_it(camera: GenTLCamera) -> None:
    camera.arm()
    process = process_of(camera)
    camera.close()
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_two_cameras_have_a_process_each(camera: GenTLCamera) -> None:
    other = GenTLCamera(settings(serial="SN_InterfaceA_0"), SHAPE, "quadrature camera")
    try:
        camera.arm()
        other.arm()
        for each in (camera, other):
            frame = taken(each)
            assert (frame.pixels == ramp(frame)).all()
    finally:
        other.close()


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"serial": "B4711"}, r"serial: got B4711, wanted one of .*SN_InterfaceB_0"),
        ({"producer": "/nowhere/maker.cti"}, "producer: got /nowhere/maker.cti: no such file, wanted"),
        ({"producer": __file__}, "producer"),
        ({"trigger_source": "Line0"}, "trigger_source: got Line0, wanted one of .*Software"),
        ({"exposure_us": 100}, "exposure_us: got 100.0, wanted no such key: the camera knows no"),
        ({"gain_db": 1}, "gain_db: got 1.0, wanted no such key: the camera does not know it"),
        ({"offset_x_px": 8}, "offset_x_px: got 8, wanted "),
        ({"pixel_format": "Mono12p"}, "pixel_format: got Mono12p, wanted one of Mono8"),
        ({"pixel_format": "Mono12"}, "PayloadSize: got 3072, wanted 6144 or more"),
    ],
)
def test_what_it_does_not_take_is_named(
    changes: dict[str, object], told: str, capfd: pytest.CaptureFixture[str]
) -> None:
    camera = GenTLCamera(settings(**changes), SHAPE, "in-phase camera")
    try:
        with pytest.raises(SourceError, match=told):
            camera.arm()
    finally:
        camera.close()
    assert capfd.readouterr().err == ""  # its error says all of it


def test_a_region_that_the_sensor_has_not_is_named() -> None:
    camera = GenTLCamera(settings(), (48, 63), "in-phase camera")
    try:
        with pytest.raises(SourceError, match="columns of the profile's camera: got 63, wanted "):
            camera.arm()
    finally:
        camera.close()


def test_another_thread_goes_on_while_frames_come(camera: GenTLCamera) -> None:
    """harvesters holds the interpreter while it waits; only its own process may notice."""
    camera.arm()
    ticks, done = list[float](), threading.Event()

    def tick() -> None:
        while not done.wait(1e-3):
            ticks.append(time.monotonic())

    thread = threading.Thread(target=tick)
    thread.start()
    try:
        assert camera.frame(0.5) is None
    finally:
        done.set()
        thread.join()
    assert len(ticks) > 100


def test_two_of_them_make_pairs(camera: GenTLCamera) -> None:
    """TLSimu's clock begins anew with each second, so that shots over its end are lost, and no more than those."""
    other = GenTLCamera(settings(serial="SN_InterfaceA_0"), SHAPE, "quadrature camera")
    try:
        for each in (camera, other):
            each.arm()
        pairing = Pairing((camera, other), SoftwareTrigger((camera, other)))
        pairs = 0
        for _ in range(12):
            try:
                frames = pairing.shot(time.monotonic() + 5)
            except LostShotError as lost:
                if lost.reason not in (Reason.OTHER_SHOT, Reason.NOT_SYNCHRONISED):
                    raise
                continue
            pairs += 1
            for frame in frames:
                assert (frame.pixels == ramp(frame)).all()
        assert pairs
    finally:
        other.close()
