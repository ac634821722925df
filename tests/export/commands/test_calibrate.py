"""`lightpage calibrate`: writes what it found, says that it found nothing, and never writes a guess."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from lightpage.calibration.calibrate import Registered
from lightpage.calibration.document import Calibration, load_calibration
from lightpage.calibration.goodness.verdict import Reading
from lightpage.calibration.parameters import NAMES, PRIORS
from lightpage.device.profile import load_profile
from lightpage.errors import CalibrationError, FrameError, LightpageError, RecordingError
from lightpage.export.commands import calibrate as command
from lightpage.export.commands.calibrate import calibrate
from lightpage.progress import reporting
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.recalibration.from_nominal import OtherGraphsWantedError
from tests.lightpage.small import EXPLAINED, UNEXPLAINED
from tests.told import Told

NOTHING_READ = Reading(
    in_sample=False, pages=4, air_bits=0.1, air_standard_error_bits=0.02, light_bits=6.9, user_bytes=0
)


def run(recording: Path, out: Path, *more: str, profile: str = "") -> str:
    named = ["--profile", profile] if profile else []
    arguments = [*named, "--recording", str(recording), "--out", str(out), *more]
    told = Told()
    with reporting(told):
        result = CliRunner().invoke(calibrate, arguments, standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return "\n".join([*told.notes, result.output])


def flat_recording(
    path: Path, level: int, pages: int = 2, with_symbols: bool = True, dark: int = 0, reference: int | None = None
) -> Path:
    """A bench recording whose frames are all one count, behind some pages without light."""
    profile = load_profile("bench")
    symbols = np.random.default_rng(0).integers(0, 16, profile.page_shape, dtype=np.uint8)

    def pair(count: int) -> FramePair:
        frame = np.full(profile.frame_shape, count, dtype=np.uint8)
        return FramePair(frame, frame)

    with RecordingWriter(path, profile, 16, 8, pair(level if reference is None else reference)) as writer:
        for count in [0] * dark + [level] * pages:
            writer.append(symbols if with_symbols else None, pair(count))
    return path


def fake_registration(monkeypatch: pytest.MonkeyPatch, outcome: Registered | BaseException) -> None:
    def register(*_: object, **__: object) -> Registered:
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr("lightpage.train.trainers.calibration.registration.calibrate", register)


REGISTERED = Registered(
    parameters=np.where(np.array(NAMES) == "pipe_angle_rad", np.deg2rad(-0.6), 0.001 * PRIORS),
    deviations=PRIORS / 50,
    quadrature_phase=np.deg2rad(-88.0),
    coherence_before=0.02,
    coherence_after=0.71,
    cost=1.0,
    significant=0.5,
    goodness=EXPLAINED,
    quadrature_deviation=np.deg2rad(0.123),
)
EARLIER = Calibration.from_registered(REGISTERED, load_profile("bench"), ["0" * 64]).to_toml()


@pytest.fixture
def recorded(small_device: list[str], tmp_path: Path) -> tuple[Path, str]:
    """A copy of a realistic device's recording, and the name of its profile."""
    return Path(shutil.copy(small_device[3], tmp_path / "R.h5")), small_device[1]


def test_symbols_that_were_not_written_find_nothing(recorded: tuple[Path, str], tmp_path: Path) -> None:
    with h5py.File(recorded[0], "r+") as file:
        symbols = file["symbols"][()]
        file["symbols"][...] = np.random.default_rng(0).permutation(symbols.ravel()).reshape(symbols.shape)
    with pytest.raises(CalibrationError):
        run(recorded[0], tmp_path / "calibration.toml", "--pages", "1", profile=recorded[1])
    assert not (tmp_path / "calibration.toml").exists()


@pytest.mark.parametrize("level", [0, 255])
def test_black_and_saturated_frames_are_refused(tmp_path: Path, level: int) -> None:
    with pytest.raises(FrameError, match="reference, in-phase"):
        run(flat_recording(tmp_path / "R.h5", 100, reference=level), tmp_path / "calibration.toml")
    with pytest.raises(RecordingError, match="2 of them"):
        run(flat_recording(tmp_path / "R2.h5", level, reference=100), tmp_path / "calibration.toml")
    assert not (tmp_path / "calibration.toml").exists()


def test_pages_without_light_are_named_and_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_registration(monkeypatch, REGISTERED)
    path = flat_recording(tmp_path / "R.h5", 100, pages=2, dark=2)
    text = run(path, tmp_path / "calibration.toml")
    assert all(f"page {page}, in-phase frame" in text for page in (0, 1))
    with Recording.open(path) as recording:
        expected = tuple(recording.page_hash(page) for page in (2, 3))
    assert load_calibration(tmp_path / "calibration.toml").calibrated_pages == expected


def test_symbols_whose_light_misses_a_camera_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    aside = np.where(np.array(NAMES) == "in_phase_shift_x_px", 100.0, REGISTERED.parameters)
    fake_registration(monkeypatch, replace(REGISTERED, parameters=aside))
    figures = tmp_path / "figures.json"
    run(flat_recording(tmp_path / "R.h5", 100), tmp_path / "calibration.toml", "--json", str(figures))
    # columns at 24, 39, 55, 70 and 86 pixels are moved beyond the camera's edge
    assert json.loads(figures.read_text())["symbols_beside_cameras"] == 5 * 56


def test_what_was_found_is_written_as_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_registration(monkeypatch, REGISTERED)
    out, figures = tmp_path / "calibration.toml", tmp_path / "figures.json"
    run(flat_recording(tmp_path / "R.h5", 100), out, "--json", str(figures))
    data, calibration = json.loads(figures.read_text()), load_calibration(out)
    assert data["angle_deg"] == pytest.approx(-0.6)
    assert (data["turn_deg"], data["turn_deviation_deg"]) == pytest.approx((-88, 0.123))
    assert (data["pages_used"], data["coherence_before"], data["coherence_after"]) == (2, 0.02, 0.71)
    assert data["parameters"] == calibration.parameters
    assert data["symbols_beside_cameras"] == 0
    profile = load_profile("bench")
    wall_m = profile.pipe.width_m / 2
    phase = np.pi * data["axial_mm"]["modulator"] / 1e3 * wall_m**2
    phase /= profile.light.wavelength_m * profile.lens.focal_length_m**2
    assert phase == pytest.approx(calibration.parameters["modulator_axial_rad"])
    assert data["goodness"] == EXPLAINED.model_copy(update={"verdict": "not judged"}).model_dump(mode="json")
    assert data["reading"] is None


def test_a_wrong_fit_is_an_error_and_is_there_to_be_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_registration(monkeypatch, replace(REGISTERED, goodness=UNEXPLAINED))

    def read_nothing(decoder: object, calibration: Calibration, *more: object) -> Calibration:
        return calibration.judged(NOTHING_READ)

    monkeypatch.setattr(command, "judged_by_reading", read_nothing)
    out, picture = tmp_path / "calibration.toml", tmp_path / "left.png"
    asked = flat_recording(tmp_path / "R.h5", 100), out, "--picture", str(picture)
    with pytest.raises(CalibrationError, match="wrong fit"):
        run(*asked)
    assert load_calibration(out).reading == NOTHING_READ
    assert picture.read_bytes().startswith(b"\x89PNG")
    for earlier, said in ((EARLIER, "name another"), (load_profile("bench").to_toml(), "--force")):
        out.write_text(earlier)
        with pytest.raises(LightpageError, match=said):
            run(*asked)
        assert out.read_text() == earlier


@pytest.mark.parametrize(
    ("pages", "with_symbols", "profile", "complaint"),
    [(2, False, "bench", "'symbols'"), (1, True, "bench", "--pages"), (2, True, "paper", "3648 x 5472")],
)
def test_a_recording_that_cannot_serve_is_refused_by_name(
    tmp_path: Path, pages: int, with_symbols: bool, profile: str, complaint: str
) -> None:
    recording = flat_recording(tmp_path / "R.h5", 100, pages, with_symbols)
    with pytest.raises(RecordingError, match=complaint):
        run(recording, tmp_path / "calibration.toml", profile=profile)


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), CalibrationError("calibration", "nothing", "something")])
def test_a_calibration_that_is_stopped_leaves_the_earlier_one_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: BaseException
) -> None:
    fake_registration(monkeypatch, stop)
    recording, out = flat_recording(tmp_path / "R.h5", 100), tmp_path / "calibration.toml"
    out.write_text(EARLIER)
    with pytest.raises((click.Abort, LightpageError)):
        run(recording, out, "--json", str(tmp_path / "figures.json"))
    assert out.read_text() == EARLIER
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["R.h5", "calibration.toml"]


@pytest.mark.parametrize(
    ("flipped", "named", "options"),
    [
        ({"quadrature": -1}, "quadrature camera mirrored left to right", "--flip-quadrature x"),
        (
            {"in_phase": (-2, -1), "quadrature": (-2, -1)},
            "in-phase camera turned by 180 degrees and quadrature",
            "--turn-in-phase 180 --turn-quadrature 180",
        ),
    ],
)
def test_a_camera_that_is_mounted_otherwise_is_named(
    flipped: dict[str, Any], named: str, options: str, recorded: tuple[Path, str], tmp_path: Path
) -> None:
    with h5py.File(recorded[0], "r+") as file:
        for name, axes in flipped.items():
            for dataset in (file[f"reference_{name}"], file[name]):
                dataset[...] = np.flip(dataset[()], axes)
    with pytest.raises(CalibrationError, match=named) as refusal:
        run(recorded[0], tmp_path / "C.toml", "--pages", "1")
    assert f"lightpage import {options})" in str(refusal.value)
    assert not (tmp_path / "C.toml").exists()


def test_a_device_that_the_shipped_graphs_do_not_allow_for_is_calibrated_with_torch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> Calibration:
        raise OtherGraphsWantedError("graphs", "cameras that see different planes", "graphs of this device")

    recording = flat_recording(tmp_path / "R.h5", 100)
    fake_registration(monkeypatch, REGISTERED)
    monkeypatch.setattr("lightpage.export.commands.calibrate.calibrating_decoder", lambda *_: object())
    monkeypatch.setattr("lightpage.export.commands.calibrate.calibrate_by_graphs", refuse)
    with pytest.raises(OtherGraphsWantedError):
        run(recording, tmp_path / "named.toml", "--graphs", "bench")
    assert "different planes" in run(recording, tmp_path / "C.toml")
    assert load_calibration(tmp_path / "C.toml").angle_deg(load_profile("bench")) == pytest.approx(-0.6)
    monkeypatch.setitem(sys.modules, "lightpage.train.trainers.calibration", None)
    with pytest.raises(CalibrationError, match=r"different planes.*torch"):
        run(recording, tmp_path / "D.toml")


@pytest.mark.parametrize(
    ("shown", "named"),
    [
        pytest.param(
            lambda symbols: np.roll(symbols, 1, axis=0),
            "the frames of known page 0 show those of page 1",
            marks=pytest.mark.long,
        ),
        (lambda symbols: symbols // 4, "1/4 of the levels"),
    ],
)
def test_symbols_that_were_shown_otherwise_are_named(
    shown: Callable[[np.ndarray], np.ndarray], named: str, recorded: tuple[Path, str], tmp_path: Path
) -> None:
    with h5py.File(recorded[0], "r+") as file:
        file["symbols"][...] = shown(file["symbols"][()])
    with pytest.raises(CalibrationError, match=named):
        run(recorded[0], tmp_path / "C.toml")
