"""A camera over Aravis: real GigE Vision packets from a fake camera, and all that can go wrong on the way."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from runtime.cameras.aravis import AravisCamera
from runtime.cameras.aravis_library import AravisError, AravisLibrary, aravis
from runtime.cameras.camera import Camera, FrameStatus
from runtime.cameras.gige_network import CONTROL_PRIVILEGE, read_register
from runtime.cameras.settings import CameraSettings
from runtime.errors import LostShotError, Reason, SourceError
from runtime.virtual_device.fake_camera import FakeCamera
from tests.runtime.cameras.scene import ADDRESS, SENSOR, SERIAL, WAIT_S, Scene, info_of, noise, scene
from tests.waiting import eventually

FORMATS = ("Mono8", "Mono10", "Mono10p", "Mono10Packed", "Mono12", "Mono12p", "Mono12Packed", "Mono16")

pytestmark = pytest.mark.own_network


def gone(act: Callable[[], object]) -> str:
    """What is said of a camera that has gone away."""
    with pytest.raises(LostShotError) as raised:
        act()
    assert raised.value.reason is Reason.CAMERA_GONE
    return raised.value.subject


@pytest.fixture
def instead(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Puts functions in the place of the library's; each has the library's own one first."""
    call = AravisLibrary.__call__

    def put(**functions: Callable[..., Any]) -> None:
        def called(self: AravisLibrary, name: str, *arguments: Any) -> Any:
            def own(*given: Any) -> Any:
                return call(self, name, *given)

            return functions[name](own, *arguments) if name in functions else own(*arguments)

        monkeypatch.setattr(AravisLibrary, "__call__", called)

    return put


def equal(stage: Scene, seed: int) -> bool:
    """Whether the next frame shows to the byte what the camera sees."""
    stage.seen[0] = noise(stage.pixel_format, seed)
    frame = stage.take()
    info_of(frame)
    assert frame.pixels is not None
    return frame.pixels.dtype == stage.seen[0].dtype and bool((frame.pixels == stage.seen[0]).all())


@pytest.mark.parametrize("pixel_format", FORMATS)
def test_every_format_arrives_to_the_byte(pixel_format: str) -> None:
    with scene(pixel_format=pixel_format, packet_bytes=1400, exposure_us=750) as stage:
        camera: Camera = stage.camera
        assert camera.name == f"in-phase camera ({ADDRESS})"
        camera.arm()
        assert camera.name == f"in-phase camera ({SERIAL})"
        assert all(equal(stage, seed) for seed in range(3))
        info = info_of(stage.take())
        assert (info.serial, info.pixel_format) == (SERIAL, pixel_format)
        assert info.exposure_s == pytest.approx(750e-6)
        assert 1.7e9 < info.host_time_s < 1e10  # since 1970
        assert (camera.frame_shape, camera.frame_numbers, camera.opened) == (SENSOR, 65535, 1)
        assert (stage.camera.statistics.completed, stage.camera.packet_bytes) == (4, 1400)


def test_a_region_is_cut_out_where_it_was_asked_for() -> None:
    with scene((24, 40), offset_x_px=16, offset_y_px=7, gain_db=3) as stage:
        stage.camera.arm()
        pixels = stage.take().pixels
        assert pixels is not None
        assert (pixels == stage.seen[0][7:31, 16:56]).all()


def test_numbers_follow_over_the_end_of_16_bits() -> None:
    with scene() as stage:
        stage.camera.arm()
        numbers = [info_of(stage.take()).frame_id for _ in range(137)]
        assert numbers[:2] == [65401, 65402]
        assert numbers[134:] == [65535, 1, 2]


def test_a_command_triggers_and_an_edge_then_does_not() -> None:
    with scene(trigger_source="Software") as stage:
        stage.camera.arm()
        assert not stage.fake.edge()
        assert stage.camera.frame(0.05) is None
        stage.camera.fire()
        frame = stage.camera.frame(WAIT_S)
        assert frame is not None
        info_of(frame)
        assert stage.camera.frame(0.0) is None
        stage.fake.close()
        gone(stage.camera.fire)


def test_only_an_edge_on_the_line_that_is_set_triggers() -> None:
    with scene(trigger_source="Line0") as stage:
        stage.camera.arm()
        assert stage.camera.frame(0.0) is None
        assert not stage.fake.edge("Line1")
        assert stage.fake.edge("Line0")
        assert stage.camera.frame(WAIT_S) is not None


def test_no_frame_of_a_free_run_passes_for_a_triggered_one() -> None:
    with scene() as stage:
        stage.camera.arm()
        for turn in range(3):
            stage.seen[0] = np.zeros(SENSOR, np.uint8)
            stage.fake.run_freely(0.004)
            before = stage.camera.statistics.completed
            eventually(lambda before=before: stage.camera.statistics.completed >= before + 3)  # type: ignore[misc]
            stage.camera.arm()
            stage.seen[0] = np.full(SENSOR, turn + 1, np.uint8)
            frame = stage.take()
            info_of(frame)
            assert frame.pixels is not None
            assert (frame.pixels == turn + 1).all()
            assert stage.camera.frame(0.02) is None


def test_a_frame_with_lost_packets_is_incomplete_and_the_next_is_whole() -> None:
    """Of 26 packets half are lost: the first one, with number and size, of some frames, and of the others pixels."""
    with scene(packet_bytes=576) as stage:
        stage.camera.arm()
        info_of(stage.take())
        stage.fake.lose(0.5)
        for _ in range(6):
            frame = stage.take()
            assert (frame.status, frame.info, frame.pixels) == (FrameStatus.INCOMPLETE, None, None)
            assert frame.detail
        stage.fake.lose(0.0)
        info_of(stage.take())
        statistics = stage.camera.statistics
        assert (statistics.completed, statistics.failures) == (2, 6)
        stage.camera.disarm()
        assert stage.camera.statistics == statistics


@pytest.mark.parametrize("found_by", ["serial", "address"])
def test_a_camera_that_goes_is_lost_and_found_again(found_by: str) -> None:
    given: dict[str, Any] = {"serial": SERIAL, "address": None} if found_by == "serial" else {}
    with scene(**given) as stage:
        stage.camera.arm()
        last = info_of(stage.take()).frame_id
        stage.fake.close()
        assert SERIAL in gone(lambda: stage.camera.frame(0.1))
        gone(stage.camera.arm)
        assert stage.camera.opened == 1
        stage.fake.start()
        stage.camera.arm()
        assert stage.camera.opened == 2
        assert info_of(stage.take()).frame_id == 65401 == last
        assert stage.camera.statistics.completed == 2
        stage.fake.close()
        stage.fake.start()  # it answers as if it had just been switched on
        gone(lambda: stage.camera.frame(0.1))
        stage.camera.arm()
        info_of(stage.take())


def test_disarmed_it_waits_for_nothing_and_arms_again() -> None:
    with scene() as stage:
        assert read_register(ADDRESS, CONTROL_PRIVILEGE) == 0
        stage.camera.arm()
        assert read_register(ADDRESS, CONTROL_PRIVILEGE)
        stage.camera.disarm()
        assert not stage.fake.edge()
        with pytest.raises(SourceError):
            stage.camera.frame(0.0)
        stage.camera.arm()
        info_of(stage.take())
        stage.camera.close()
        stage.camera.close()
        assert read_register(ADDRESS, CONTROL_PRIVILEGE) == 0
        gone(stage.camera.fire)
        stage.camera.arm()
        assert stage.camera.opened == 2
        info_of(stage.take())


def test_what_is_not_there_is_named_with_what_is() -> None:
    def told(**wanted: str) -> tuple[str, str]:
        with pytest.raises(SourceError) as raised:
            AravisCamera(CameraSettings.model_validate(wanted), SENSOR).arm()
        return raised.value.got, raised.value.expected

    with FakeCamera(ADDRESS, SERIAL, lambda: noise("Mono8", 0), SENSOR):
        got, expected = told(serial="CAM-X")
        assert (got, "CAM-X" in expected) == (f"{SERIAL} at {ADDRESS}", True)
        got, expected = told(address="127.0.0.2")
        assert (got, "127.0.0.2" in expected) == (f"{SERIAL} at {ADDRESS}", True)
    assert SERIAL not in told(serial=SERIAL)[0]


# The driver itself waits for seconds before it says that another program controls the camera.
@pytest.mark.long
def test_a_camera_that_another_program_controls_is_named() -> None:
    with scene() as stage:
        stage.camera.arm()
        other = AravisCamera(CameraSettings(address=ADDRESS), SENSOR)
        with pytest.raises(SourceError, match="another program"):
            other.arm()
        info_of(stage.take())


@pytest.mark.parametrize(
    ("given", "shape", "setting", "told"),
    [
        ({"pixel_format": "Mono14"}, SENSOR, "pixel_format", ("Mono14", "Mono8")),
        ({"trigger_source": "Line7"}, SENSOR, "trigger_source", ("Line7", "Line1")),
        ({"trigger_activation": "FallingEdge"}, SENSOR, "trigger_activation", ("FallingEdge", "RisingEdge")),
        ({"exposure_us": 1e9}, SENSOR, "exposure_us", ("1000000000.0", "10000000")),
        ({"gain_db": 2.5}, SENSOR, "gain_db", ("2.5", "2.0", "0 to 10")),
        ({"gain_db": 99.0}, SENSOR, "gain_db", ("99.0", "0 to 10")),
        ({"black_level_counts": 4}, SENSOR, "black_level_counts", ("4",)),
        ({}, (97, 128), "region", ("128 x 97", "128 x 96")),
    ],
)
def test_a_setting_that_it_does_not_take_is_named(
    given: dict[str, Any], shape: tuple[int, int], setting: str, told: tuple[str, ...]
) -> None:
    with scene(shape, **given) as stage, pytest.raises(SourceError) as raised:
        stage.camera.arm()
    assert setting in raised.value.subject
    for part in told:
        assert part in f"{raised.value.got} {raised.value.expected}"


def test_what_it_takes_and_then_forgets_is_named(instead: Callable[..., None]) -> None:
    """As `set_frame_rate` does: the trigger is off again, and nothing has failed."""

    def forgets(own: Callable[..., Any], camera: int, feature: bytes, value: bytes) -> None:
        own(camera, feature, b"Off" if feature == b"TriggerMode" else value)

    instead(arv_camera_set_string=forgets)
    with scene() as stage, pytest.raises(SourceError, match="TriggerMode"):
        stage.camera.arm()


@pytest.mark.parametrize(("pixel_format", "more"), [("Mono8", 312), ("Mono12p", 1), ("Mono12p", 5000)])
def test_a_payload_that_is_larger_than_the_pixels_is_taken(pixel_format: str, more: int) -> None:
    with scene(more_bytes=more, pixel_format=pixel_format, packet_bytes=1400) as stage:
        stage.camera.arm()
        assert all(equal(stage, seed) for seed in range(3))


def test_a_payload_that_is_smaller_than_the_pixels_is_refused() -> None:
    with scene(more_bytes=-1) as stage, pytest.raises(SourceError, match="PayloadSize") as raised:
        stage.camera.arm()
    assert raised.value.got == "12287"


def test_padding_behind_each_line_is_left_out(instead: Callable[..., None]) -> None:
    """The fake camera pads nothing: it is given eight columns more, which are said to be padding."""
    rows, columns = SENSOR

    def padding(own: Callable[..., Any], buffer: int, x: Any, y: Any) -> None:
        ctypes.cast(x, ctypes.POINTER(ctypes.c_int))[0] = 8

    def get_region(own: Callable[..., Any], camera: int, *corners: Any) -> None:
        own(camera, *corners)
        ctypes.cast(corners[2], ctypes.POINTER(ctypes.c_int))[0] -= 8

    instead(
        arv_camera_set_region=lambda own, camera, x, y, columns, rows: own(camera, x, y, columns + 8, rows),
        arv_camera_get_region=get_region,
        arv_buffer_get_image_width=lambda own, buffer: own(buffer) - 8,
        arv_buffer_get_image_padding=padding,
    )
    with scene((rows, columns - 8)) as stage:
        stage.camera.arm()
        pixels = stage.take().pixels
        assert pixels is not None
        assert (pixels == stage.seen[0][:, : columns - 8]).all()


def test_a_frame_that_ends_too_soon_is_incomplete(instead: Callable[..., None]) -> None:
    def shorter(own: Callable[..., Any], buffer: int, size: Any) -> Any:
        place = own(buffer, size)
        if size is not None:  # as the fake camera calls it
            ctypes.cast(size, ctypes.POINTER(ctypes.c_size_t))[0] -= 1
        return place

    instead(arv_buffer_get_data=shorter)
    with scene() as stage:
        stage.camera.arm()
        frame = stage.take()
        assert frame.status is FrameStatus.INCOMPLETE
        assert re.search(r"\b12287\b", frame.detail)


@pytest.mark.parametrize(("own", "other"), [("Mono8", "Mono16"), ("Mono16", "Mono8")])
def test_a_camera_whose_pixel_format_somebody_changes_is_set_up_again(own: str, other: str) -> None:
    with scene(pixel_format=own) as stage:
        stage.seen[0] = noise("Mono8", 3)
        stage.camera.arm()
        stage.fake.change_format(other)
        assert stage.fake.edge()
        gone(lambda: stage.camera.frame(WAIT_S))
        stage.camera.arm()
        assert stage.camera.opened == 1
        info_of(stage.take())


def test_an_error_of_the_library_is_an_exception() -> None:
    with pytest.raises(AravisError) as raised:
        aravis()("arv_camera_new", b"no-such-camera")
    assert (raised.value.domain, raised.value.code) == ("arv-device-error-quark", 6)
