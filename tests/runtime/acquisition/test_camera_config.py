"""The file that wires a device is checked before anything is connected."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lightpage.errors import InvalidInputError, LightpageError
from runtime.acquisition.camera_config import load_device_table, open_camera
from runtime.acquisition.camera_source import CameraSource
from runtime.cameras.aravis import AravisCamera
from runtime.cameras.gentl import GenTLCamera
from runtime.errors import SourceError
from runtime.modulator.external import ExternalBeams, ExternalModulator
from runtime.modulator.operator import OperatorBeams
from runtime.modulator.screen import ScreenModulator
from runtime.modulator.shutters import ShutterBeams

EXAMPLE = Path(__file__).parents[3] / "docs" / "camera-example.toml"
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
    source = open_camera(str(EXAMPLE))
    assert source.frame_shape == (3648, 5472)
    assert isinstance(source.modulator, ScreenModulator)
    assert isinstance(source.beams, ShutterBeams)
    assert [view.flip_x for view in source._views] == [False, True]
    source.pages.close()


def test_what_is_left_out_is_done_by_hand(tmp_path: Path) -> None:
    source = opened(tmp_path, PLAIN)
    assert (source.levels, source.bit_depth) == (16, 8)
    assert source.modulator is None
    assert isinstance(source.beams, OperatorBeams)
    with pytest.raises(SourceError, match=r"lightpage record.*Block the signal beam"):
        source.references()
    asked: list[str] = []
    source.operator = asked.append
    source.beams.let_through(signal=False, reference=True)
    assert asked == ["Block the signal beam"]


def test_a_camera_may_have_a_producer_beside_the_file(tmp_path: Path) -> None:
    source = opened(tmp_path, PLAIN.replace('serial = "2"', 'serial = "2"\ndriver = "gentl"\nproducer = "maker.cti"'))
    assert [type(camera) for camera in source._cameras] == [AravisCamera, GenTLCamera]
    with pytest.raises(SourceError, match=re.escape(str(tmp_path / "maker.cti"))):
        source._cameras[1].arm()
    source.close()


def test_a_controller_may_do_all_of_it(tmp_path: Path) -> None:
    text = PLAIN + '[modulator]\nkind = "external"\n[beams]\nkind = "external"\ntimeout_s = 2\n'
    source = opened(tmp_path, text)
    assert isinstance(source.modulator, ExternalModulator)
    assert isinstance(source.beams, ExternalBeams)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("profile =", "TOML"),
        (PLAIN.replace("levels = 16", "levels = 1"), "levels"),
        (
            PLAIN.replace('serial = "1"', 'serial = "1"\naddress = "1.2.3.4"'),
            r"device\.toml: in_phase: got serial and address, wanted one of them \(docs/cameras\.md, all keys\)$",
        ),
        (PLAIN.replace('serial = "1"', "flip_y = true"), "in_phase: got neither serial nor address, wanted one of"),
        (PLAIN.replace('serial = "1"', 'serial = "1"\ncolour = "red"'), "in_phase.colour: got an unknown key"),
        (
            PLAIN.replace('serial = "1"', 'serial = "1"\nexposure_u = 2'),
            "exposure_u: got an unknown key, wanted exposure_us",
        ),
        (
            PLAIN.replace('serial = "1"', 'serial = "1"\nexposure_us = "200"'),
            r"exposure_us: got '200', wanted a number",
        ),
        (PLAIN.replace('serial = "1"', 'serial = "1"\nexposure_us = true'), r"exposure_us: got true, wanted a number"),
        (PLAIN.replace('serial = "1"', 'serial = "1"\nbuffers = 1'), r"in_phase\.buffers: got 1, wanted at least 2"),
        (PLAIN.replace('serial = "2"', 'serial = "1"'), "serial 1 for in_phase and for quadrature, wanted two cameras"),
        (PLAIN.replace('"software"', '"bell"'), r"trigger\.kind: got 'bell', wanted pulse_generator or software"),
        (PLAIN.replace('kind = "software"', ""), "trigger: got no kind, wanted pulse_generator or software"),
        (PLAIN.replace('[trigger]\nkind = "software"', ""), "got no trigger, wanted one"),
        (PLAIN.replace('"software"', '"pulse_generator"'), "trigger: got no port, wanted one"),
        (PULSES.replace("channels = [1, 2]", "baud = 3"), r"device\.toml: trigger\.baud: got 3, wanted at least 1200"),
        (
            PULSES.replace("channels = [1, 2]", "channels = [1, 1]"),
            "trigger.channels: got a channel twice, wanted each once",
        ),
        (
            PULSES.replace("channels = [1, 2]", "channels = [1, true]"),
            r"trigger\.channels\.1: got true, wanted a whole number",
        ),
        (
            PULSES + '[beams]\nkind = "shutters"\nsignal = {channel = 2}\nreference = {channel = 4}\n',
            r"beams\.signal\.channel = 2, wanted none of the cameras' \(1, 2\)",
        ),
        (
            PLAIN.replace("levels = 16", "levels = 16\nlevel = 3").replace('"software"', '"bell"'),
            r"got 2 mistakes: trigger\.kind: .bell. \(wanted pulse.*; level: an unknown key \(wanted levels\), wanted",
        ),
        (PLAIN.replace('"bench"', '"nowhere"'), "nowhere"),
        (PLAIN + '[beams]\nkind = "shutters"\nsignal = {channel = 3}\nreference = {channel = 4}\n', "pulse_generator"),
        (PLAIN + "[pairing]\ntolerance_s = 0.05\nspacing_s = 0.06\n", "pairing: got spacing_s = 0.06, wanted at l"),
        (PLAIN.replace("levels = 16", 'levels = 16\npages = "absent.h5"'), "absent.h5"),
    ],
)
def test_a_file_that_makes_no_device_is_refused_by_the_name_of_the_key(tmp_path: Path, text: str, named: str) -> None:
    with pytest.raises(LightpageError, match=named):
        opened(tmp_path, text)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"absent\.toml"):
        load_device_table(tmp_path / "absent.toml")
    (tmp_path / "device.toml").write_text(PLAIN)
    with pytest.raises(InvalidInputError, match="pages only"):
        open_camera(f"{tmp_path / 'device.toml'}?levels=4")
