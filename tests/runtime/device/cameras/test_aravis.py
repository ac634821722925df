"""A camera over Aravis: real GigE Vision packets from a fake camera, and all that can go wrong on the way."""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from lightpage.errors import Reason, SourceError
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.device.cameras.aravis import AravisCamera
from lightpage.runtime.device.cameras.aravis_library import AravisLibrary
from lightpage.runtime.device.cameras.camera import BrokenFrame, Camera, Frame
from lightpage.runtime.device.cameras.gige_network import CONTROL_PRIVILEGE, read_register
from lightpage.runtime.device.cameras.pixel_formats import bit_depth
from lightpage.runtime.device.cameras.settings import CameraSettings
from lightpage.virtual_device.fake_camera import FakeCamera
from tests.runtime.device.acquisition.lab import reason_of
from tests.waiting import eventually

SENSOR = (96, 128)
ADDRESS = "127.0.0.1"
SERIAL = "CAM-I"
WAIT_S = 30.0

F = TypeVar("F", Frame, BrokenFrame)
Counts = NDArray[np.unsignedinteger[Any]]

pytestmark = pytest.mark.own_network


def noise(pixel_format: str, seed: int) -> Counts:
    """Counts of every size that the format has."""
    depth = bit_depth(pixel_format)
    return np.random.default_rng(seed).integers(0, 2**depth, SENSOR, dtype=np.uint8 if depth == 8 else np.uint16)


@dataclass
class Scene:
    """A fake camera, its driver, and what the sensor sees."""

    fake: FakeCamera
    camera: AravisCamera
    seen: list[Counts]

    def take(self, kind: type[F]) -> F:
        """One edge, one frame: a whole one, or one of which parts are missing."""
        assert self.fake.edge()
        frame = self.camera.frame(WAIT_S)
        assert isinstance(frame, kind), frame
        return frame

    def info(self) -> FrameInfo:
        """Of the next frame, which is complete and shows to the byte what the camera sees."""
        frame = self.take(Frame)
        assert frame.pixels.dtype == self.seen[0].dtype
        rows, columns = frame.pixels.shape
        assert (frame.pixels == self.seen[0][:rows, :columns]).all()
        return frame.info


@contextmanager
def scene(shape: tuple[int, int] = SENSOR, more_bytes: int = 0, **settings: Any) -> Iterator[Scene]:
    """A fake camera at ADDRESS, and a driver that is not armed yet."""
    given = {"address": ADDRESS, "trigger_source": "Line1", **settings}
    camera = AravisCamera(CameraSettings.model_validate(given), shape, "in-phase camera")
    seen = [noise(settings.get("pixel_format", "Mono8"), 0)]
    with FakeCamera(ADDRESS, SERIAL, lambda: seen[0], SENSOR, more_bytes) as fake:
        try:
            yield Scene(fake, camera, seen)
            fake.check()
        finally:
            camera.close()


def gone(act: Callable[[], object]) -> None:
    assert reason_of(act, "in-phase camera") is Reason.CAMERA_GONE


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono10Packed", "Mono12p", "Mono16"])
def test_every_format_arrives_to_the_byte(pixel_format: str) -> None:
    with scene(pixel_format=pixel_format, packet_bytes=1400, exposure_us=750) as stage:
        camera: Camera = stage.camera
        assert camera.name == f"in-phase camera ({ADDRESS})"
        camera.arm()
        assert camera.name == f"in-phase camera ({SERIAL})"
        for seed in range(2):
            stage.seen[0] = noise(pixel_format, seed)
            assert stage.info().frame_id == 65401 + seed
        info = stage.info()
        assert (info.serial, info.pixel_format) == (SERIAL, pixel_format)
        assert info.exposure_s == pytest.approx(750e-6)
        assert 1.7e9 < info.host_time_s < 1e10  # since 1970
        assert (camera.frame_numbers, camera.opened, stage.camera.whole_frames) == (65535, 1, 3)


def test_a_region_is_cut_out_where_it_was_asked_for() -> None:
    with scene((24, 40), offset_x_px=16, offset_y_px=7, gain_db=3) as stage:
        stage.camera.arm()
        pixels = stage.take(Frame).pixels
        assert (pixels == stage.seen[0][7:31, 16:56]).all()


def test_a_command_triggers_and_an_edge_then_does_not() -> None:
    with scene(trigger_source="Software") as stage:
        stage.camera.arm()
        assert not stage.fake.edge()
        assert stage.camera.frame(0.05) is None
        stage.camera.fire()
        assert isinstance(stage.camera.frame(WAIT_S), Frame)
        assert stage.camera.frame(0.0) is None
        stage.fake.close()
        gone(stage.camera.fire)


def test_no_frame_of_a_free_run_passes_for_a_triggered_one() -> None:
    with scene() as stage:
        stage.camera.arm()
        for turn in range(3):
            stage.seen[0] = np.zeros(SENSOR, np.uint8)
            stage.fake.run_freely(0.004)
            before = stage.camera.whole_frames
            eventually(lambda before=before: stage.camera.whole_frames >= before + 3)  # type: ignore[misc]
            stage.camera.arm()
            stage.seen[0] = np.full(SENSOR, turn + 1, np.uint8)
            stage.info()
            assert stage.camera.frame(0.02) is None


def test_a_frame_with_lost_packets_is_incomplete_and_the_next_is_whole() -> None:
    """Of 26 packets half are lost: the first one, with number and size, of some frames, and of the others pixels."""
    with scene(packet_bytes=576) as stage:
        stage.camera.arm()
        stage.info()
        stage.fake.lose(0.5)
        for _ in range(6):
            assert stage.take(BrokenFrame).detail
        stage.fake.lose(0.0)
        stage.info()
        assert stage.camera.whole_frames == 2
        stage.camera.disarm()
        assert stage.camera.whole_frames == 2


@pytest.mark.parametrize("found_by", [{"serial": SERIAL, "address": None}, {}])
def test_a_camera_that_goes_is_lost_and_found_again(found_by: dict[str, Any]) -> None:
    with scene(**found_by) as stage:
        stage.camera.arm()
        stage.info()
        stage.fake.close()
        gone(lambda: stage.camera.frame(0.1))
        gone(stage.camera.arm)
        assert stage.camera.opened == 1
        stage.fake.start()
        stage.camera.arm()
        assert stage.camera.opened == 2
        stage.info()
        assert stage.camera.whole_frames == 2
        stage.fake.close()
        stage.fake.start()  # it answers as if it had just been switched on
        gone(lambda: stage.camera.frame(0.1))
        stage.camera.arm()
        stage.info()


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
        stage.info()
        stage.camera.close()
        stage.camera.close()
        assert read_register(ADDRESS, CONTROL_PRIVILEGE) == 0
        gone(stage.camera.fire)
        stage.camera.arm()
        assert stage.camera.opened == 2


def test_what_is_not_there_is_named_with_what_is() -> None:
    with FakeCamera(ADDRESS, SERIAL, lambda: noise("Mono8", 0), SENSOR):
        for wanted in ({"serial": "CAM-X"}, {"address": "127.0.0.2"}):
            with pytest.raises(SourceError) as raised:
                AravisCamera(CameraSettings.model_validate(wanted), SENSOR).arm()
            assert raised.value.got == f"{SERIAL} at {ADDRESS}"
            assert next(iter(wanted.values())) in raised.value.expected


# The driver itself waits for seconds before it says that another program controls the camera.
@pytest.mark.long
def test_a_camera_that_another_program_controls_is_named() -> None:
    with scene() as stage:
        stage.camera.arm()
        other = AravisCamera(CameraSettings(address=ADDRESS), SENSOR)
        with pytest.raises(SourceError, match="another program"):
            other.arm()
        stage.info()


@pytest.mark.parametrize(
    ("given", "shape", "setting", "got", "expected"),
    [
        ({"pixel_format": "Mono14"}, SENSOR, "pixel_format", "Mono14", "Mono8"),
        ({"exposure_us": 1e9}, SENSOR, "exposure_us", "1000000000.0", "10000000"),
        ({"gain_db": 2.5}, SENSOR, "gain_db", "2.0", "0 to 10"),
        ({}, (97, 128), "region", "128 x 97", "128 x 96"),
    ],
)
def test_a_setting_that_it_does_not_take_is_named(
    given: dict[str, Any], shape: tuple[int, int], setting: str, got: str, expected: str
) -> None:
    with scene(shape, **given) as stage, pytest.raises(SourceError) as raised:
        stage.camera.arm()
    assert setting in raised.value.subject
    assert (got in str(raised.value.got), expected in str(raised.value.expected)) == (True, True)


@pytest.mark.parametrize(("pixel_format", "more"), [("Mono8", 312), ("Mono12p", 1)])
def test_a_payload_that_is_larger_than_the_pixels_is_taken_and_a_smaller_one_is_not(
    pixel_format: str, more: int
) -> None:
    with scene(more_bytes=more, pixel_format=pixel_format, packet_bytes=1400) as stage:
        stage.camera.arm()
        stage.info()
    with scene(more_bytes=-1) as stage, pytest.raises(SourceError, match="PayloadSize") as raised:
        stage.camera.arm()
    assert raised.value.got == "12287"


def test_what_it_takes_and_then_forgets_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `set_frame_rate` does: the trigger is off again, and nothing has failed."""
    call = AravisLibrary.__call__

    def forgets(library: AravisLibrary, name: str, *given: Any) -> Any:
        off = name == "arv_camera_set_string" and given[1] == b"TriggerMode"
        return call(library, name, *((*given[:2], b"Off") if off else given))

    monkeypatch.setattr(AravisLibrary, "__call__", forgets)
    with scene() as stage, pytest.raises(SourceError, match="TriggerMode"):
        stage.camera.arm()


def test_a_frame_that_ends_too_soon_is_incomplete(monkeypatch: pytest.MonkeyPatch) -> None:
    call = AravisLibrary.__call__

    def shorter(library: AravisLibrary, name: str, *given: Any) -> Any:
        found = call(library, name, *given)
        if name == "arv_buffer_get_data" and given[1] is not None:  # as the fake camera calls it
            ctypes.cast(given[1], ctypes.POINTER(ctypes.c_size_t))[0] -= 1
        return found

    monkeypatch.setattr(AravisLibrary, "__call__", shorter)
    with scene() as stage:
        stage.camera.arm()
        assert "12287 bytes" in stage.take(BrokenFrame).detail


@pytest.mark.parametrize(("own", "other"), [("Mono8", "Mono16"), ("Mono16", "Mono8")])
def test_a_camera_whose_pixel_format_somebody_changes_is_set_up_again(own: str, other: str) -> None:
    with scene(pixel_format=own) as stage:
        stage.camera.arm()
        stage.fake.change_format(other)
        stage.seen[0] = noise("Mono8", 3)
        assert stage.fake.edge()
        gone(lambda: stage.camera.frame(WAIT_S))
        stage.camera.arm()
        assert stage.camera.opened == 1
        stage.take(Frame)
