"""A camera over Aravis: real GigE Vision packets from a fake camera, and all that can go wrong on the way."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from runtime.cameras import aravis_setup
from runtime.cameras.aravis import AravisCamera
from runtime.cameras.aravis_library import aravis
from runtime.cameras.camera import Camera, FrameStatus
from runtime.cameras.pixel_formats import pixel_format as format_of
from runtime.cameras.settings import CameraSettings
from runtime.errors import LostShotError, Reason, SourceError
from runtime.virtual_device.fake_camera import FakeCamera
from tests.runtime.cameras.scene import ADDRESS, SENSOR, SERIAL, WAIT_S, info_of, noise, scene, until

FORMATS = ("Mono8", "Mono10", "Mono10p", "Mono10Packed", "Mono12", "Mono12p", "Mono12Packed", "Mono16")

pytestmark = pytest.mark.own_network


def test_every_format_arrives_to_the_byte() -> None:
    for pixel_format in FORMATS:
        with scene(pixel_format=pixel_format, packet_bytes=1400, exposure_us=750) as stage:
            camera: Camera = stage.camera
            camera.arm()
            for seed in range(5):
                stage.seen[0] = noise(pixel_format, seed)
                frame = stage.take()
                info = info_of(frame)
                assert frame.pixels is not None
                assert (frame.pixels == stage.seen[0]).all()
                assert frame.pixels.dtype == stage.seen[0].dtype
                assert (info.serial, info.pixel_format) == (SERIAL, pixel_format)
                assert info.exposure_s == pytest.approx(750e-6)
                assert abs(info.host_time_s - time.time()) < 5
            assert stage.camera.statistics.completed == 5
            assert stage.camera.packet_bytes == 1400


def test_what_the_camera_counts_in_and_is_called() -> None:
    with scene(pixel_format="Mono12p") as stage:
        assert stage.camera.name == f"in-phase camera ({ADDRESS})"
        stage.camera.arm()
        assert stage.camera.name == f"in-phase camera ({SERIAL})"
        assert (stage.camera.bit_depth, stage.camera.frame_numbers, stage.camera.opened) == (12, 65535, 1)
        assert stage.camera.frame_shape == SENSOR


def test_a_region_is_cut_out_where_it_was_asked_for() -> None:
    with scene((24, 40), offset_x_px=16, offset_y_px=7) as stage:
        stage.camera.arm()
        pixels = stage.take().pixels
        assert pixels is not None
        assert (pixels == stage.seen[0][7:31, 16:56]).all()


def test_a_frame_is_a_copy() -> None:
    with scene(buffers=2) as stage:
        stage.camera.arm()
        first = stage.take().pixels
        assert first is not None
        kept = first.copy()
        for seed in range(1, 5):
            stage.seen[0] = noise("Mono8", seed)
            stage.take()
        assert (first == kept).all()


def test_numbers_follow_over_the_end_of_16_bits() -> None:
    with scene() as stage:
        stage.camera.arm()
        numbers = [info_of(stage.take()).frame_id for _ in range(140)]
        assert numbers[:2] == [65401, 65402]
        assert numbers[134:136] == [65535, 1]
        follow = stage.camera.frame_numbers
        assert [number % follow + 1 for number in numbers[:-1]] == numbers[1:]


def test_a_command_triggers_and_an_edge_then_does_not() -> None:
    with scene(trigger_source="Software") as stage:
        stage.camera.arm()
        assert not stage.fake.edge()
        assert stage.camera.frame(0.3) is None
        stage.camera.fire()
        frame = stage.camera.frame(WAIT_S)
        assert frame is not None
        info_of(frame)
        assert stage.camera.frame(0.0) is None


def test_only_an_edge_on_the_line_that_is_set_triggers() -> None:
    with scene(trigger_source="Line0") as stage:
        stage.camera.arm()
        assert not stage.fake.edge("Line1")
        assert stage.fake.edge("Line0")
        assert stage.camera.frame(WAIT_S) is not None


def test_no_frame_of_a_free_run_passes_for_a_triggered_one() -> None:
    with scene() as stage:
        stage.camera.arm()
        for turn in range(10):
            stage.seen[0] = np.zeros(SENSOR, np.uint8)
            stage.fake.run_freely(0.004)
            completed = stage.camera.statistics.completed
            until(lambda before=completed: stage.camera.statistics.completed >= before + 3)  # type: ignore[misc]
            stage.camera.arm()
            stage.seen[0] = np.full(SENSOR, turn + 1, np.uint8)
            fired = time.time()
            frame = stage.take()
            assert info_of(frame).device_time_s >= fired - 1e-3
            assert frame.pixels is not None
            assert (frame.pixels == turn + 1).all()
            assert stage.camera.frame(0.02) is None


def test_a_frame_with_lost_packets_is_incomplete_and_the_next_is_whole() -> None:
    """Of 26 packets half are lost: the first one, with number and size, of some frames, and of the others pixels."""
    with scene(packet_bytes=576) as stage:
        stage.camera.arm()
        info_of(stage.take())
        stage.fake.lose(0.5)
        for _ in range(12):
            frame = stage.take()
            assert frame.status is FrameStatus.INCOMPLETE
            assert frame.info is None
            assert frame.pixels is None
            assert frame.detail
        stage.fake.lose(0.0)
        info_of(stage.take())
        statistics = stage.camera.statistics
        assert (statistics.completed, statistics.failures) == (2, 12)
        stage.camera.disarm()
        assert stage.camera.statistics == statistics


def test_no_trigger_no_frame() -> None:
    with scene() as stage:
        stage.camera.arm()
        assert stage.camera.frame(0.0) is None
        started = time.monotonic()
        assert stage.camera.frame(0.1) is None
        assert 0.09 < time.monotonic() - started < WAIT_S


@pytest.mark.parametrize("found_by", ["serial", "address"])
def test_a_camera_that_goes_is_lost_quickly_and_found_again(found_by: str) -> None:
    given: dict[str, Any] = {"serial": SERIAL, "address": None} if found_by == "serial" else {}
    with scene(**given) as stage:
        stage.camera.arm()
        last = info_of(stage.take()).frame_id
        stage.fake.close()
        started = time.monotonic()
        with pytest.raises(LostShotError, match=rf"in-phase camera \({SERIAL}\)") as raised:
            stage.camera.frame(0.1)
        assert raised.value.reason is Reason.CAMERA_GONE
        with pytest.raises(LostShotError) as raised:
            stage.camera.arm()
        assert raised.value.reason is Reason.CAMERA_GONE
        assert time.monotonic() - started < WAIT_S
        assert stage.camera.opened == 1
        stage.fake.start()
        stage.camera.arm()
        assert stage.camera.opened == 2
        assert info_of(stage.take()).frame_id == 65401 == last
        assert stage.camera.statistics.completed == 2


def test_a_camera_that_was_switched_off_and_on_is_lost_too() -> None:
    with scene() as stage:
        stage.camera.arm()
        stage.fake.close()
        stage.fake.start()
        with pytest.raises(LostShotError) as raised:
            stage.camera.frame(0.1)
        assert raised.value.reason is Reason.CAMERA_GONE
        stage.camera.arm()
        info_of(stage.take())


def test_a_command_to_a_camera_that_is_gone_is_a_lost_shot() -> None:
    with scene(trigger_source="Software") as stage:
        stage.camera.arm()
        stage.fake.close()
        with pytest.raises(LostShotError) as raised:
            stage.camera.fire()
        assert raised.value.reason is Reason.CAMERA_GONE


def test_disarmed_it_waits_for_nothing_and_arms_again() -> None:
    with scene() as stage:
        stage.camera.arm()
        stage.camera.disarm()
        assert not stage.fake.edge()
        with pytest.raises(SourceError, match="not armed"):
            stage.camera.frame(0.0)
        stage.camera.arm()
        info_of(stage.take())
        stage.camera.close()
        stage.camera.close()
        with pytest.raises(LostShotError, match="not armed"):
            stage.camera.fire()
        stage.camera.arm()
        assert stage.camera.opened == 2
        info_of(stage.take())


def test_what_is_not_there_is_named_with_what_is() -> None:
    with FakeCamera(ADDRESS, SERIAL, lambda: noise("Mono8", 0), SENSOR):
        for wanted, told in ((CameraSettings(serial="CAM-X"), "CAM-X"), (CameraSettings(address="127.0.0.2"), "0.0.2")):
            with pytest.raises(SourceError, match=rf"{SERIAL} at {ADDRESS}.*{told}"):
                AravisCamera(wanted, SENSOR).arm()
    with pytest.raises(SourceError, match="no camera at all"):
        AravisCamera(CameraSettings(serial=SERIAL), SENSOR).arm()
    with pytest.raises(SourceError, match=r"no\.host\.invalid"):
        AravisCamera(CameraSettings(address="no.host.invalid"), SENSOR).arm()


def test_a_camera_that_another_program_controls_is_named() -> None:
    with scene() as stage:
        stage.camera.arm()
        other = AravisCamera(CameraSettings(address=ADDRESS), SENSOR)
        with pytest.raises(SourceError, match="another program"):
            other.arm()
        info_of(stage.take())


@pytest.mark.parametrize(
    ("given", "shape", "told"),
    [
        ({"pixel_format": "Mono14"}, SENSOR, r"pixel_format: got Mono14, wanted one of .*Mono8"),
        ({"trigger_source": "Line7"}, SENSOR, r"trigger_source: got Line7, wanted one of .*Line1"),
        (
            {"trigger_activation": "FallingEdge"},
            SENSOR,
            r"trigger_activation: got FallingEdge, wanted one of .*RisingEdge",
        ),
        ({"exposure_us": 1e9}, SENSOR, r"exposure_us: got 1000000000\.0, wanted \d+ to 10000000, in its steps"),
        ({"gain_db": 2.5}, SENSOR, r"gain_db: got 2\.5, of which the camera makes 2\.0, wanted 0 to 10, in its steps"),
        ({"gain_db": 99.0}, SENSOR, r"gain_db: got 99\.0, wanted 0 to 10"),
        ({"black_level_counts": 4}, SENSOR, "black_level_counts: got 4, wanted what the camera knows"),
        (
            {},
            (SENSOR[0] + 1, SENSOR[1]),
            r"region .* got 128 x 97 pixels at \(0, 0\), wanted a region of its sensor, 128 x 96",
        ),
    ],
)
def test_a_setting_that_it_does_not_take_is_named(given: dict[str, Any], shape: tuple[int, int], told: str) -> None:
    with scene(shape, **given) as stage, pytest.raises(SourceError, match=told):
        stage.camera.arm()


def test_what_it_takes_and_then_forgets_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `set_frame_rate` does: the trigger is off again, and nothing has failed."""
    set_trigger = aravis_setup.AravisSetup.set_trigger

    def forgets(self: aravis_setup.AravisSetup) -> None:
        set_trigger(self)
        aravis()("arv_camera_set_string", self.connection.handle, b"TriggerMode", b"Off")

    monkeypatch.setattr(aravis_setup.AravisSetup, "set_trigger", forgets)
    with scene() as stage, pytest.raises(SourceError, match="TriggerMode: got Off, wanted On"):
        stage.camera.arm()


def test_gain_is_taken() -> None:
    with scene(gain_db=3) as stage:
        stage.camera.arm()
        info_of(stage.take())


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono12p"])
@pytest.mark.parametrize("more", [1, 312, 5000])
def test_a_payload_that_is_larger_than_the_pixels_is_taken(pixel_format: str, more: int) -> None:
    with scene(more_bytes=more, pixel_format=pixel_format, packet_bytes=1400) as stage:
        stage.camera.arm()
        for seed in range(3):
            stage.seen[0] = noise(pixel_format, seed)
            frame = stage.take()
            info_of(frame)
            assert frame.pixels is not None
            assert (frame.pixels == stage.seen[0]).all()


def test_a_payload_that_is_smaller_than_the_pixels_is_refused() -> None:
    with (
        scene(more_bytes=-1) as stage,
        pytest.raises(SourceError, match="PayloadSize: got 12287, wanted 12288"),
    ):
        stage.camera.arm()


def test_padding_behind_each_line_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fake camera pads nothing: its library is made to say that the last columns are padding."""
    rows, columns = SENSOR

    def padding(buffer: int, x: Any, y: Any) -> None:
        x._obj.value = 8

    with scene((rows, columns)) as stage:
        stage.camera.arm()
        monkeypatch.setitem(aravis()._functions, "arv_buffer_get_image_padding", padding)
        monkeypatch.setitem(aravis()._functions, "arv_buffer_get_image_width", lambda buffer: columns - 8)
        stage.camera._shape = (rows, columns - 8)
        pixels = stage.take().pixels
        assert pixels is not None
        assert (pixels == stage.seen[0][:, : columns - 8]).all()


def test_a_frame_that_ends_too_soon_is_incomplete(monkeypatch: pytest.MonkeyPatch) -> None:
    with scene() as stage:
        stage.camera.arm()
        monkeypatch.setitem(aravis()._functions, "arv_buffer_get_image_height", lambda buffer: SENSOR[0] + 1)
        stage.camera._shape = (SENSOR[0] + 1, SENSOR[1])
        frame = stage.take()
        assert frame.status is FrameStatus.INCOMPLETE
        assert "12288 bytes" in frame.detail


@pytest.mark.parametrize(("own", "other"), [("Mono8", "Mono16"), ("Mono16", "Mono8")])
def test_a_camera_whose_pixel_format_somebody_changes_is_set_up_again(own: str, other: str) -> None:
    with scene(pixel_format=own) as stage:
        stage.seen[0] = noise("Mono8", 3)
        stage.camera.arm()
        stage.fake._write(0x128, format_of(other).code)  # behind its user's back
        assert stage.fake.edge()
        with pytest.raises(LostShotError, match="settings") as raised:
            stage.camera.frame(WAIT_S)
        assert raised.value.reason is Reason.CAMERA_GONE
        stage.camera.arm()
        assert stage.camera.opened == 1
        info_of(stage.take())
