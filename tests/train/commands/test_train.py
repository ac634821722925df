"""`lightpage train` on a small device: a run, its interruption, and what it refuses."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import pytest
import torch
from click.testing import CliRunner

from lightpage.calibration.document import Calibration, load_calibration
from lightpage.device.profile import Profile
from lightpage.errors import CalibrationError, InvalidInputError
from lightpage.page.symbols import pilot_mask
from lightpage.progress import Progress, reporting
from lightpage.recording.reader import Recording
from tests.conftest import SMALL_PAGES
from tests.lightpage.small import small_profile
from tests.told import Told
from train.commands import train as cli_train
from train.commands.options import chosen_localizer, chosen_trainer
from train.commands.train import train
from train.data.feature_store import FeatureStore
from train.fitting import provenance as origin
from train.fitting.curves import curves_of
from train.fitting.provenance import provenance, provenance_of
from train.models.hyperparameters import Hyperparameters
from train.models.presets import PRESETS
from train.runs import FORMAT, begin, check_begun, sole_writer
from train.trainers.symbols import SymbolTrainer
from train.trainers.whole_run import own_pilots

SECONDS = 120


@pytest.fixture(scope="module")
def device(small_device: list[str]) -> list[str]:
    """Options of a run on the small device with a small network."""
    return [*small_device, "--channels", "8", "--blocks", "1", "--refinements", "0"]


def run(arguments: list[str]) -> str:
    done = CliRunner().invoke(train, arguments, standalone_mode=False, catch_exceptions=False)
    return done.output


def test_recorded_and_synthetic_pages_are_trained_on_and_the_last_are_left(device: list[str], tmp_path: Path) -> None:
    output = run([*device, "--steps", "60", "--synthetic-pages", "5", "--out", str(tmp_path / "run")])
    assert "6 recorded and 5 synthetic pages" in output
    described = json.loads((tmp_path / "run" / "run.json").read_text())
    assert described["synthetic_pages"] == 5
    assert len(described["trained_pages"]) == SMALL_PAGES - 1
    # another run begins where this one ended, and one of another size says why it cannot
    again = [
        *device,
        "--steps",
        "10",
        "--learning-rate",
        "1e-9",
        "--synthetic-pages",
        "0",
        "--start",
        str(tmp_path / "run"),
    ]
    run([*again, "--out", str(tmp_path / "again")])
    air = json.loads((tmp_path / "again" / "run.json").read_text())["validation_air"]
    assert air == pytest.approx(described["validation_air"], abs=1e-3)
    with pytest.raises(InvalidInputError, match=r"channels, blocks, depth.*16"):
        run([*again, "--channels", "16", "--out", str(tmp_path / "other")])


@pytest.mark.long
def test_a_run_begins_with_the_refinements_of_another_too(small_device: list[str], tmp_path: Path) -> None:
    small = [*small_device, "--channels", "8", "--blocks", "1", "--synthetic-pages", "0"]
    run([*small, "--steps", "60", "--out", str(tmp_path / "run")])
    still = ["--learning-rate", "1e-9", "--steps", "10", "--start", str(tmp_path / "run")]
    run([*small, *still, "--out", str(tmp_path / "again")])
    before, after = (torch.load(tmp_path / name / "decoder.pt", weights_only=True) for name in ("run", "again"))
    names = [name for name in before if name.startswith("refiners.")]
    assert names
    for name in names:
        torch.testing.assert_close(after[name], before[name], rtol=0, atol=1e-5)


def test_options_of_the_first_pass_are_kept_and_those_that_do_nothing_refused(
    small_device: list[str], tmp_path: Path
) -> None:
    small = [*small_device, "--channels", "8", "--blocks", "1", "--steps", "12", "--synthetic-pages", "0"]
    fast = [
        "--binning",
        "2",
        "--field-step",
        "3",
        "--samples",
        "3",
        "--interpolation",
        "bilinear",
        "--field-rounds",
        "0",
        "--patch",
        "20",
    ]
    run([*small, *fast, "--out", str(tmp_path / "run")])
    kept = json.loads((tmp_path / "run" / "run.json").read_text())["hyperparameters"]
    assert {
        name: kept[name] for name in ("binning", "field_step", "samples", "interpolation", "field_rounds", "patch")
    } == {
        "binning": 2,
        "field_step": 3,
        "samples": 3,
        "interpolation": "bilinear",
        "field_rounds": 0,
        "patch": 20,
    }
    assert kept["refinements"] == 1  # unless told otherwise
    with pytest.raises(InvalidInputError, match=r"--samples"):
        run([*small, "--localizer", "wave", "--samples", "3", "--out", str(tmp_path / "wave")])
    start = ["--start", str(tmp_path / "run"), "--out", str(tmp_path / "other")]
    with pytest.raises(InvalidInputError, match=r"samples: got .*3\), wanted .*4\)"):
        run([*small, *start])


@pytest.mark.parametrize(
    ("kind", "status"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.long)]
)
def test_training_that_is_stopped_loses_nothing_and_the_same_command_goes_on(
    kind: signal.Signals, status: int, device: list[str], tmp_path: Path
) -> None:
    out, steps = (
        tmp_path / "run",
        360,
    )  # a multiple of sixty: the last pass at the validation pages is after the last step
    arguments = [*device, "--steps", str(steps), "--synthetic-pages", "0", "--out", str(out)]
    command = [sys.executable, "-m", "lightpage.cli.main", "train", *arguments]
    last = out / "checkpoints" / "last.ckpt"
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        end = time.monotonic() + SECONDS
        while not last.exists() and time.monotonic() < end and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(kind)
        output, _ = process.communicate(timeout=SECONDS)
    finally:
        process.kill()
    assert process.returncode == status, output
    assert "run the same command again" in output
    assert not (out / "run.json").exists()
    reached = torch.load(last, map_location="cpu", weights_only=False)["global_step"]
    assert 0 < reached < steps
    run(arguments)
    assert torch.load(last, map_location="cpu", weights_only=False)["global_step"] == steps
    assert (out / "run.json").exists()


def test_a_finished_run_is_told_again_and_not_touched(device: list[str], tmp_path: Path) -> None:
    arguments = [*device, "--steps", "10", "--synthetic-pages", "0", "--out", str(tmp_path / "run")]
    told = run(arguments).splitlines()[-1]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")}
    assert run([*arguments, "--json", str(tmp_path / "F")]).splitlines()[-1] == told
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")} == before
    figures = json.loads((tmp_path / "F").read_text())
    assert figures["pages"] == {"training": 6, "validation": 1, "left_for_evaluate": 1}
    assert figures["training_seconds"] > 0


def test_dark_pages_are_named_and_left_out(device: list[str], tmp_path: Path) -> None:
    path = tmp_path / "R.h5"
    shutil.copy(device[3], path)
    with h5py.File(path, "r+") as file:
        file["quadrature"][0] = 0
        file["in_phase"][6] = 255
    told, options = Told(), [*device[:3], str(path), *device[4:], "--steps", "10", "--synthetic-pages", "2"]
    with reporting(told):
        output = run([*options, "--out", str(tmp_path / "run")])
    assert "4 recorded and 2 synthetic pages trained on, 1 validation pages, 1 left" in output
    dark, bright = told.notes[:2]
    assert "page 0, quadrature frame: got black" in dark
    assert "page 6, in-phase frame: got saturated" in bright
    with Recording.open(path) as recording:
        expected = [recording.page_hash(page) for page in (1, 2, 3, 4, 5)]
    assert json.loads((tmp_path / "run" / "run.json").read_text())["trained_pages"] == expected


def test_two_processes_train_one_run_and_its_refinement(small_device: list[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    small = [*small_device, "--channels", "8", "--blocks", "1", "--synthetic-pages", "0"]
    arguments = [*small, "--steps", "60", "--devices", "2", "--out", str(out)]
    command = [sys.executable, "-m", "lightpage.cli.main", "train", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=2 * SECONDS)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("validation AIR") == 1
    assert json.loads((out / "run.json").read_text())["validation_air"] > 0.5
    passes = curves_of(out)["val_air"]
    assert len(passes) == 60  # as many as one process takes
    kept = FeatureStore(out / "refinement-1" / "features")
    assert all(bool(light.any()) for light, *_ in (kept[index] for index in range(len(kept))))


def test_pilots_of_the_devices_own_are_found(device: list[str], tmp_path: Path) -> None:
    profile = small_profile()
    mask = pilot_mask(profile)
    path = tmp_path / "R.h5"
    shutil.copy(device[3], path)
    told = Told()
    with Recording.open(path) as recording, reporting(told):
        assert own_pilots(recording, profile, mask, [0, 1, 2]) is None
        assert not told.notes
    with h5py.File(path, "r+") as file:
        symbols = file["symbols"][:]
        symbols[:, mask] = 64
        file["symbols"][:] = symbols
    with Recording.open(path) as recording:
        own = own_pilots(recording, profile, mask, [0, 1, 2])
    np.testing.assert_allclose(own, np.full(mask.sum(), np.pi / 2), rtol=1e-6)
    with h5py.File(path, "r+") as file:
        symbols[1][mask] = 65
        file["symbols"][:] = symbols
    with Recording.open(path) as recording, reporting(told):
        assert own_pilots(recording, profile, mask, [0, 1, 2]) is None
    assert "no piston" in told.notes[0]


def test_a_calibration_of_another_device_is_refused(device: list[str], tmp_path: Path) -> None:
    text = Path(device[5]).read_text()
    start = text.index("turn_rad = ")
    inverted = text[:start] + "turn_rad = -1.6" + text[text.index("\n", start) :]
    (tmp_path / "C.toml").write_text(inverted)
    other = [*device[:5], str(tmp_path / "C.toml"), *device[6:]]
    with pytest.raises(CalibrationError, match="calibration against the recording"):
        run([*other, "--steps", "60", "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


def test_a_calibration_of_a_device_with_another_angle_is_refused(device: list[str], tmp_path: Path) -> None:
    calibration = load_calibration(device[5])
    angle = calibration.parameters["pipe_angle_rad"] + float(np.deg2rad(1))
    changed = {"parameters": calibration.parameters | {"pipe_angle_rad": angle}}
    calibration.model_copy(update=changed).save(tmp_path / "C.toml")
    with pytest.raises(CalibrationError, match=r"calibration against the recording: got a coherence of 0\.[34]"):
        run([*device[:5], str(tmp_path / "C.toml"), *device[6:], "--steps", "60", "--out", str(tmp_path / "run")])


def test_other_options_are_refused_before_a_calibration_is_made(
    device: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    arguments = [*device[:4], *device[6:], "--out", str(tmp_path)]
    with monkeypatch.context() as patch:
        patch.setattr("train.trainers.whole_run.check_begun", begin)
        patch.setattr("train.commands.train._calibration", interrupt)
        with pytest.raises(click.Abort):
            run([*arguments, "--steps", "60"])
    with pytest.raises(InvalidInputError, match=r"--steps: got 70, wanted 60, with which it was begun"):
        run([*arguments, "--steps", "70"])
    assert [path.name for path in tmp_path.iterdir()] == ["begun.json"]


def test_options_that_cannot_be_are_named(device: list[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match=r"--out .*file"):
        run([*device, "--out", str(tmp_path / "file")])
    with pytest.raises(InvalidInputError, match=r"--learning-rate.*nan"):
        run([*device, "--learning-rate", "nan", "--out", str(tmp_path / "run")])
    with pytest.raises(click.BadParameter, match="nan is not a finite number"):
        run([*device, "--test-share", "nan", "--out", str(tmp_path / "run")])
    with pytest.raises(click.BadParameter, match="bf16-mixed"):
        run([*device, "--precision", "foo", "--out", str(tmp_path / "run")])


def test_shares_that_leave_nothing_to_train_on_are_named(device: list[str], tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"validation-share and --test-share.*4 validation and 4 test pages"):
        run([*device, "--validation-share", "0.5", "--test-share", "0.5", "--out", str(tmp_path / "run")])


@pytest.mark.parametrize("left", ["checkpoints", "fitted.json"])
def test_weights_of_unknown_origin_are_not_taken_up(left: str, tmp_path: Path) -> None:
    (tmp_path / left).mkdir()
    with pytest.raises(InvalidInputError, match="unknown origin"):
        begin(tmp_path, {"--steps": 60})


def test_a_run_is_calibrated_on_its_first_usable_pages(
    device: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[list[int]] = []

    def found(recording: Recording, profile: Profile, pages: Sequence[int], progress: Progress) -> Calibration:
        made.append(list(pages))
        hashes = tuple(recording.page_hash(page) for page in pages)
        return load_calibration(device[5]).model_copy(update={"calibrated_pages": hashes})

    monkeypatch.setattr(cli_train, "calibrate_recording", found)
    path = tmp_path / "R.h5"
    shutil.copy(device[3], path)
    with h5py.File(path, "r+") as file:
        file["quadrature"][0] = 0
    arguments = [*device[:3], str(path), *device[6:], "--steps", "10", "--synthetic-pages", "0"]
    (tmp_path / "run").mkdir()
    load_calibration(device[5]).save(tmp_path / "run" / "calibration.toml")  # of other pages: not taken
    run([*arguments, "--out", str(tmp_path / "run")])
    run([*arguments, "--out", str(tmp_path / "run")])
    assert made == [[1, 2]]


def test_a_run_does_not_go_on_with_other_symbols(device: list[str], tmp_path: Path) -> None:
    path = tmp_path / "R.h5"
    shutil.copy(device[3], path)
    arguments = [*device[:3], str(path), *device[4:], "--steps", "10", "--synthetic-pages", "0"]
    run([*arguments, "--out", str(tmp_path / "run")])
    with h5py.File(path, "r+") as file:
        file["symbols"][3, 0, 0] ^= 1
    with pytest.raises(InvalidInputError, match=r"--recording .*frames and symbols.*with which it was begun"):
        run([*arguments, "--out", str(tmp_path / "run")])


def test_a_run_of_another_version_is_named_as_such(tmp_path: Path) -> None:
    begin(tmp_path, {"--steps": 60})
    (tmp_path / "begun.json").write_text(json.dumps({"format": FORMAT - 1, "--steps": 60}))
    with pytest.raises(InvalidInputError, match=f"format: got {FORMAT - 1}, wanted {FORMAT}, which this version"):
        begin(tmp_path, {"--steps": 60})


def test_what_differs_is_named_and_not_the_whole_of_it(tmp_path: Path) -> None:
    begin(tmp_path, {"calibration": "a = 1\nb = 2\n", "device": {"sensor": {"full_well_e": 32, "noise": 1}}})
    with pytest.raises(InvalidInputError, match="calibration: got b = 3, wanted 'b = 2', with which"):
        begin(tmp_path, {"calibration": "a = 1\nb = 3\n"})
    with pytest.raises(InvalidInputError, match="got sensor: full_well_e: 64, wanted 'sensor: full_well_e: 32'"):
        begin(tmp_path, {"device": {"sensor": {"full_well_e": 64, "noise": 1}}})


@pytest.fixture
def asked_anew() -> Iterator[None]:
    """The commit is asked for again in this test, and in those after it."""
    origin._commit.cache_clear()
    yield
    origin._commit.cache_clear()


@pytest.mark.usefixtures("asked_anew")
def test_without_git_there_is_no_commit_and_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert provenance()["commit"] == ""


@pytest.mark.usefixtures("asked_anew")
def test_what_a_training_is_of_is_what_was_there_when_it_began(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = {"rev-parse": f"{Path(origin.__file__).parents[2]}\nabc", "status": ""}
    monkeypatch.setattr(origin, "_git", lambda tree, command, *options: said[command])
    first = provenance_of(tmp_path)
    assert first["commit"] == "abc"
    said |= {"rev-parse": said["rev-parse"] + "d", "status": " M train/fitting/fit.py"}
    assert provenance_of(tmp_path) == first  # another commit while it works
    origin._commit.cache_clear()  # another process goes on with it
    assert provenance_of(tmp_path) == first | {"commit": f"abcd{origin.CHANGED}", "begun_at_commit": "abc"}
    said["rev-parse"] = "/elsewhere\nabc"
    origin._commit.cache_clear()
    assert provenance()["commit"] == ""


def test_a_second_training_in_the_same_folder_is_refused(device: list[str], tmp_path: Path) -> None:
    with sole_writer(tmp_path), pytest.raises(InvalidInputError, match=r"another process.*another --out"):
        run([*device, "--steps", "10", "--out", str(tmp_path)])
    with sole_writer(tmp_path):
        pass


def test_a_run_does_not_go_on_with_other_options(tmp_path: Path) -> None:
    options = {"--channels": 8, "--steps": 60}
    begin(tmp_path, options)
    begin(tmp_path, options)
    with pytest.raises(InvalidInputError, match=r"--channels.*16.*8, with which it was begun"):
        begin(tmp_path, options | {"--channels": 16})
    with pytest.raises(InvalidInputError, match=r"begun without --rate, wanted the version that began the run"):
        begin(tmp_path, options | {"--channels": [8, 16], "--rate": 0.1})


def test_the_depth_of_the_network_is_known_by_its_earlier_name(tmp_path: Path) -> None:
    (tmp_path / "begun.json").write_text(json.dumps({"format": FORMAT, "--channels": 8, "--levels": 1}))
    assert check_begun(tmp_path, {"--channels": 8, "--depth": 1})
    with pytest.raises(InvalidInputError, match="--depth: got 0, wanted 1, with which it was begun"):
        check_begun(tmp_path, {"--channels": 8, "--depth": 0})
    required = ["--profile", "bench", "--recording", "R.h5", "--out", str(tmp_path)]
    for flag in ("--depth", "--levels"):
        with train.make_context("train", [*required, flag, "2"]) as context:
            assert context.params["depth"] == 2


def test_a_preset_is_what_it_says_and_single_options_change_it() -> None:
    profile = small_profile()

    def chosen(**given: Any) -> Hyperparameters:
        trainer = chosen_trainer("coherent", profile, 6, given)
        assert isinstance(trainer, SymbolTrainer)
        return trainer.choices

    assert chosen() == PRESETS["accurate"].choices == Hyperparameters(refinements=1)
    assert chosen(preset="standard") == Hyperparameters()
    assert chosen(preset="fast", channels=8) == replace(PRESETS["fast"].choices, channels=8)
    with pytest.raises(InvalidInputError, match="--preset fast: got --localizer wave, wanted --localizer coherent"):
        chosen_trainer("wave", profile, 6, {"preset": "fast"})


def test_a_preset_says_which_localizer_it_has_unless_one_is_chosen() -> None:
    assert [chosen_localizer(None, preset) for preset in (None, *PRESETS)] == [
        "coherent",
        "coherent",
        "wave",
        "coherent",
    ]
    assert chosen_localizer("coherent", "standard") == "coherent"
    assert chosen_localizer("ray", None) == "ray"
