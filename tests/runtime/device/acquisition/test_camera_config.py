"""The file that wires a device is checked before anything is connected, and describes each of its keys."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

from lightpage.device.problems import tables_in
from lightpage.errors import InvalidInputError, LightpageError, SourceError
from lightpage.runtime.device.acquisition.camera_config import DeviceTable, load_device_table
from lightpage.runtime.device.acquisition.camera_devices import open_camera
from lightpage.runtime.device.acquisition.camera_source import CameraSource
from lightpage.runtime.device.cameras.aravis import AravisCamera
from lightpage.runtime.device.cameras.gentl import GenTLCamera
from lightpage.runtime.device.modulator.external import ExternalBeams, ExternalModulator
from lightpage.runtime.device.modulator.screen.screen import ScreenModulator
from lightpage.runtime.device.modulator.shutters import ShutterBeams

DOCS = Path(__file__).parents[4] / "docs"
PLAIN = """
profile = "bench"
levels = 16
[in_phase]
serial = "1"
[quadrature]
serial = "2"
flip_y = true
[trigger]
kind = "software"
"""
PULSES = PLAIN.replace('"software"', '"pulse_generator"\nport = "/dev/null"\nchannels = [1, 2]')


def opened(tmp_path: Path, text: str) -> CameraSource:
    (tmp_path / "device.toml").write_text(text)
    return open_camera(str(tmp_path / "device.toml"))


def test_the_example_of_the_documents_is_a_whole_device() -> None:
    source = open_camera(str(DOCS / "camera-example.toml"))
    assert source.frame_shape == (3648, 5472)
    assert isinstance(source.modulator, ScreenModulator)
    assert isinstance(source.beams, ShutterBeams)
    assert [image.view.flip_x for image in source.images] == [False, True]
    source.pages.close()


def test_what_is_left_out_is_done_by_hand(tmp_path: Path) -> None:
    source = opened(tmp_path, PLAIN)
    assert source.name == f"camera:{tmp_path / 'device.toml'}"
    assert [(image.view.flip_x, image.view.flip_y) for image in source.images] == [(False, False), (False, True)]
    assert [camera.name for camera in source.cameras] == ["in-phase camera (1)", "quadrature camera (2)"]
    assert (source.levels, source.bit_depth) == (16, 8)
    assert source.modulator is None
    with pytest.raises(SourceError, match=r"^operator"):
        source.references()
    source = opened(tmp_path, PLAIN.replace('serial = "2"', 'serial = "2"\ndriver = "gentl"\nproducer = "maker.cti"'))
    assert [type(camera) for camera in source.cameras] == [AravisCamera, GenTLCamera]
    with pytest.raises(SourceError) as raised:
        source.cameras[1].arm()
    assert str(tmp_path / "maker.cti") in raised.value.got
    source.close()


def camera(line: str) -> str:
    """The file with a line more for the in-phase camera."""
    return PLAIN.replace('serial = "1"', f'serial = "1"\n{line}')


SHUTTERS = '[beams]\nkind = "shutters"\nsignal = {channel = %d}\nreference = {channel = 4}\n'


@pytest.mark.parametrize(
    ("text", "place", "got", "expected"),
    [
        ("profile =", "", "", "TOML"),
        (PLAIN.replace("levels = 16", "levels = 1"), "levels", "1", "2"),
        (camera('address = "1.2.3.4"'), "in_phase", "serial and address", "one of"),
        (PLAIN.replace('serial = "1"', "flip_y = true"), "in_phase", "serial nor address", "one of"),
        (camera('producer = "maker.cti"'), "in_phase", "producer with", "gentl"),
        (camera('driver = "gentl"'), "in_phase", "no producer", "gentl"),
        (camera('driver = "gentl"\nproducer = "maker.cti"\npacket_bytes = 1400'), "in_phase", "packet_bytes", "aravis"),
        (camera('pixel_format = "RGB8"'), "in_phase.pixel_format", "RGB8", "Mono8"),
        (camera("exposure_u = 2"), "in_phase.exposure_u", "", "exposure_us"),
        (PLAIN.replace('serial = "2"', 'serial = "1"'), "", "serial 1", "two cameras"),
        (PLAIN.replace('"software"', '"bell"'), "trigger.kind", "'bell'", "pulse_generator or software"),
        (PULSES.replace("[1, 2]", "[1, 1]"), "trigger.channels", "twice", "once"),
        (PULSES + SHUTTERS % 2, "", "beams.signal.channel = 2", "(1, 2)"),
        (PULSES + SHUTTERS % 4, "", "channel 4 for both", "two"),
        (PLAIN + SHUTTERS % 3, "", "shutters without a pulse generator", "pulse_generator"),
        (PLAIN.replace("levels = 16", "level = 3").replace('"software"', '"bell"'), "", "2 mistakes: trigger.kind", ""),
        (PLAIN + "[pairing]\ntolerance_s = 0.05\nspacing_s = 0.06\n", "pairing", "spacing_s = 0.06", "0.125"),
    ],
)
def test_a_file_that_makes_no_device_is_refused_by_the_name_of_the_key(
    tmp_path: Path, text: str, place: str, got: str, expected: str
) -> None:
    with pytest.raises(InvalidInputError) as raised:
        opened(tmp_path, text)
    where = f": {place}" if place else ""
    assert raised.value.subject == f"camera configuration {tmp_path / 'device.toml'}{where}"
    assert got in raised.value.got
    assert expected in raised.value.expected


def test_beams_are_moved_by_shutters_or_by_a_controller(tmp_path: Path) -> None:
    assert isinstance(opened(tmp_path, PULSES + SHUTTERS % 3).beams, ShutterBeams)
    external = opened(tmp_path, PLAIN + '[modulator]\nkind = "external"\n[beams]\nkind = "external"\n')
    assert (type(external.modulator), type(external.beams)) == (ExternalModulator, ExternalBeams)


def test_files_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"absent\.toml"):
        load_device_table(tmp_path / "absent.toml")
    (tmp_path / "device.toml").write_text(PLAIN)
    with pytest.raises(InvalidInputError, match="levels=4"):
        open_camera(f"{tmp_path / 'device.toml'}?levels=4")
    for wrong in (PLAIN.replace('"bench"', '"nowhere"'), PLAIN.replace("levels = 16", 'pages = "nowhere"')):
        with pytest.raises(LightpageError, match="nowhere"):
            opened(tmp_path, wrong)
    (tmp_path / "table.csv").write_text("10 20 30 40")
    screen = '[modulator]\nkind = "screen"\nx_display = ":5"\nrows_px = 800\ncolumns_px = 1280\nlookup_table = "%s"\n'
    without = PLAIN.replace("levels = 16", "")
    for name, first in (("absent.csv", ""), ("absent.csv", "levels = 4"), ("table.csv", "levels = 8")):
        with pytest.raises(InvalidInputError, match=name):
            opened(tmp_path, first + without + screen % name)


def undescribed(table: type[BaseModel]) -> Iterator[str]:
    for name, field in table.model_fields.items():
        if not field.description:
            yield f"{table.__name__}.{name}"
        for inner in tables_in(field.annotation):
            yield from undescribed(inner)


def test_every_key_has_a_description() -> None:
    assert list(undescribed(DeviceTable)) == []
