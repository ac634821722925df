"""`lightpage train` on a small device: a run, its interruption, and what it refuses."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import pytest
import torch

from lightpage.calibration.document import Calibration, load_calibration
from lightpage.device.profile import Profile
from lightpage.errors import CalibrationError, InvalidInputError
from lightpage.metrics import provenance
from lightpage.page.symbols import pilot_mask
from lightpage.progress import reporting
from lightpage.recording.reader import Recording
from lightpage.train.commands import train as cli_train
from lightpage.train.commands.options import CHOICES, chosen_localizer, chosen_trainer, given_choices
from lightpage.train.commands.train import train
from lightpage.train.fitting.curves import curves_of
from lightpage.train.fitting.modules import SymbolTraining
from lightpage.train.fitting.provenance import provenance_of
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.presets import PRESETS, REFLECTIONS
from lightpage.train.published.training import PublishedChoices
from lightpage.train.runs import FORMAT, begin, check_begun, load_run, sole_writer
from lightpage.train.trainers.whole_run import own_pilots
from tests.lightpage import command
from tests.lightpage.small import UNEXPLAINED, small_profile
from tests.told import Told

LAST = Path("checkpoints") / "last.ckpt"


@pytest.fixture(scope="module")
def device(small_device: list[str]) -> list[str]:
    """Options of a short run on the small device with a small network."""
    size = "--channels 8 --blocks 1 --refinements 0 --synthetic-pages 0 --steps 10"
    return [*small_device, *size.split()]


@pytest.fixture
def recording(device: list[str], tmp_path: Path) -> Path:
    """A copy of its recording, to be changed."""
    return Path(shutil.copy(device[3], tmp_path / "R.h5"))


run = partial(command.run, train)


def options(*words: str) -> tuple[str, Any]:
    """The localizer of a command line, and what it says of the training."""
    required = ("--profile", "bench", "--recording", "R.h5", "--out", "run")
    with train.make_context("train", [*required, *words]) as context:
        params = context.params
    localizer = chosen_localizer(params["localizer"], params["preset"])
    given = given_choices(localizer, {choice.name: params[choice.name] for choice in CHOICES})
    return localizer, chosen_trainer(localizer, small_profile(), 450, given).choices


def test_a_preset_is_what_it_says_and_single_options_change_it() -> None:
    plain = Hyperparameters(reflections=REFLECTIONS)
    assert options() == ("coherent", PRESETS["accurate"].choices) == ("coherent", replace(plain, refinements=1))
    assert options("--preset", "standard") == ("wave", plain)
    assert options("--preset", "standard", "--localizer", "coherent") == ("coherent", plain)
    assert options("--preset", "fast", "--channels", "8") == ("coherent", replace(PRESETS["fast"].choices, channels=8))
    assert options("--depth", "2")[1].depth == 2
    assert options("--field-rounds", "0") == ("coherent", Hyperparameters(refinements=1, field_rounds=0))
    assert options("--localizer", "ray", "--channels", "8")[1] == PublishedChoices(channels=(8, 16))
    assert options("--localizer", "ray", "--held-share", "0.3")[1] == PublishedChoices(held_share=0.3)


@pytest.mark.parametrize(
    "words",
    [
        ("--samples", "3", "--localizer", "wave"),
        ("--preset", "fast", "--localizer", "wave"),
        *((option, "2", "--localizer", "ray") for option in ("--blocks", "--start")),
        ("--learning-rate", "0"),
        ("--held-share", "0.3"),
        ("--held-share", "nan", "--localizer", "ray"),
    ],
)
def test_options_that_do_nothing_or_cannot_be_are_refused(words: tuple[str, ...]) -> None:
    with pytest.raises(InvalidInputError, match=words[0]):
        options(*words)


def test_what_is_no_option_is_refused(device: list[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match=r"--out .*file"):
        run(*device, "--out", tmp_path / "file")
    with pytest.raises(click.BadParameter, match="nan"):
        run(*device, "--test-share", "nan", "--out", tmp_path / "run")
    with pytest.raises(InvalidInputError, match="4 validation"):
        run(*device, "--validation-share", "0.5", "--test-share", "0.5", "--out", tmp_path / "run")


def test_a_further_pass_reads_more_than_the_first(small_run: Path) -> None:
    described = load_run(small_run)
    first = max(air for _, air in curves_of(small_run)["val_air"])
    assert described.validation_air > first + 0.2
    assert described.pages == (4, 2, 2)
    assert len(described.trained_pages) == 6


def test_a_run_begins_with_the_weights_of_another(small_run: Path, small_device: list[str], tmp_path: Path) -> None:
    size = "--blocks 1 --validation-share 0.25 --test-share 0.25 --steps 10 --learning-rate 1e-9 --synthetic-pages 0"
    again = [*small_device, *size.split(), "--start", small_run]
    run(*again, "--channels", "12", "--out", tmp_path / "again")
    assert load_run(tmp_path / "again").validation_air == pytest.approx(load_run(small_run).validation_air, abs=0.02)
    before, after = (torch.load(folder / "decoder.pt", weights_only=True) for folder in (small_run, tmp_path / "again"))
    for name in (name for name in before if name.startswith(("network.", "refiners."))):
        torch.testing.assert_close(after[name], before[name], rtol=0, atol=1e-5)
    with pytest.raises(InvalidInputError, match="channels"):
        run(*again, "--channels", "16", "--out", tmp_path / "other")


def test_training_that_is_stopped_loses_nothing_and_the_same_command_goes_on(
    device: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, step = tmp_path / "run", SymbolTraining.training_step
    arguments = [*device, "--steps", 120, "--out", out]

    def interrupted(module: SymbolTraining, *batch: Any) -> torch.Tensor:
        if module.global_step == 70:
            raise KeyboardInterrupt
        return step(module, *batch)

    with monkeypatch.context() as patch:
        patch.setattr(SymbolTraining, "training_step", interrupted)
        with pytest.raises((click.Abort, KeyboardInterrupt, SystemExit)):
            run(*arguments)
    assert not (out / "run.json").exists()
    assert torch.load(out / LAST, map_location="cpu", weights_only=False)["global_step"] == 70
    run(*arguments)
    assert torch.load(out / LAST, map_location="cpu", weights_only=False)["global_step"] == 120
    assert (out / "run.json").exists()


def test_a_finished_run_is_told_again_and_its_options_and_symbols_stay(
    device: list[str], recording: Path, tmp_path: Path
) -> None:
    arguments = [*device[:3], recording, *device[4:], "--out", tmp_path / "run"]
    told = run(*arguments).splitlines()[-1]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")}
    assert run(*arguments, "--json", tmp_path / "F").splitlines()[-1] == told
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")} == before
    figures = json.loads((tmp_path / "F").read_text())
    assert figures["pages"] == {"training": 6, "validation": 1, "left_for_evaluate": 1}
    assert figures["training_seconds"] > 0
    with pytest.raises(InvalidInputError, match="--steps: got 70"):
        run(*arguments, "--steps", "70")
    with h5py.File(recording, "r+") as file:
        file["symbols"][3, 0, 0] ^= 1
    with pytest.raises(InvalidInputError, match="--recording"):
        run(*arguments)


def test_dark_pages_are_left_out_of_recorded_and_synthetic_ones(
    device: list[str], recording: Path, tmp_path: Path
) -> None:
    with h5py.File(recording, "r+") as file:
        file["quadrature"][0] = 0
        file["in_phase"][6] = 255
    told = Told()
    with reporting(told):
        run(*device[:3], recording, *device[4:], "--synthetic-pages", "2", "--out", tmp_path / "run")
    assert "page 0, quadrature frame" in told.notes[0]
    assert "page 6, in-phase frame" in told.notes[1]
    described = load_run(tmp_path / "run")
    assert (described.pages, described.synthetic_pages) == ((4, 1, 1), 2)
    with Recording.open(recording) as pages:
        assert list(described.trained_pages) == [pages.page_hash(page) for page in (1, 2, 3, 4, 5)]


def test_pilots_of_the_devices_own_are_found(recording: Path) -> None:
    profile, told = small_profile(), Told()
    mask = pilot_mask(profile)

    def found() -> np.ndarray | None:
        with Recording.open(recording) as file, reporting(told):
            return own_pilots(file, profile, mask, [0, 1, 2])

    assert found() is None
    assert not told.notes
    with h5py.File(recording, "r+") as file:
        symbols = file["symbols"][:]
        symbols[:, mask] = 64
        file["symbols"][:] = symbols
    np.testing.assert_allclose(found(), np.full(mask.sum(), np.pi / 2), rtol=1e-6)
    with h5py.File(recording, "r+") as file:
        symbols[1][mask] = 65
        file["symbols"][:] = symbols
    assert found() is None
    assert len(told.notes) == 1


def test_a_calibration_that_is_wrong_or_of_another_device_is_refused(device: list[str], tmp_path: Path) -> None:
    calibration = load_calibration(device[5])
    angle = calibration.parameters["pipe_angle_rad"] + float(np.deg2rad(1))
    parameters = calibration.parameters | {"pipe_angle_rad": angle}
    calibration.model_copy(update={"parameters": parameters, "goodness": UNEXPLAINED}).save(tmp_path / "C.toml")
    words = [*device[:5], tmp_path / "C.toml", *device[6:], "--out", tmp_path / "run"]
    with pytest.raises(CalibrationError, match=r"wrong fit.*--accept-wrong-fit"):
        run(*words)
    with pytest.raises(CalibrationError, match="coherence of 0"):
        run(*words, "--accept-wrong-fit")


def test_a_run_is_calibrated_on_its_first_usable_pages_once(
    device: list[str], recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[list[int]] = []

    def found(recording: Recording, profile: Profile, pages: Sequence[int], *_: object, **__: object) -> Calibration:
        made.append(list(pages))
        hashes = tuple(recording.page_hash(page) for page in pages)
        return load_calibration(device[5]).model_copy(update={"calibrated_pages": hashes})

    monkeypatch.setattr(cli_train, "calibrate_recording", found)
    with h5py.File(recording, "r+") as file:
        file["quadrature"][0] = 0
    (tmp_path / "run").mkdir()
    load_calibration(device[5]).save(tmp_path / "run" / "calibration.toml")  # of other pages: not taken
    for _ in range(2):
        run(*device[:3], recording, *device[6:], "--out", tmp_path / "run")
    assert made == [[1, 2]]


@pytest.mark.parametrize("left", ["checkpoints", "fitted.json"])
def test_weights_of_unknown_origin_are_not_taken_up(left: str, tmp_path: Path) -> None:
    (tmp_path / left).mkdir()
    with pytest.raises(InvalidInputError, match="unknown origin"):
        begin(tmp_path, {"--steps": 60})


def test_a_run_goes_on_with_its_own_options_alone(tmp_path: Path) -> None:
    begun = {"--channels": 8, "calibration": "a = 1\nb = 2\n", "device": {"sensor": {"full_well_e": 32, "noise": 1}}}
    for _ in range(2):
        begin(tmp_path, begun)
    for changed, named in (
        ({"--channels": 16}, "--channels: got 16"),
        ({"calibration": "a = 1\nb = 3\n"}, "calibration: got b"),
        ({"device": {"sensor": {"full_well_e": 64, "noise": 1}}}, "full_well_e: 64"),
        ({"--channels": [8, 16], "--rate": 0.1}, "--rate"),
    ):
        with pytest.raises(InvalidInputError, match=named):
            begin(tmp_path, begun | changed)
    (tmp_path / "begun.json").write_text(json.dumps({"format": FORMAT - 1, **begun}))
    with pytest.raises(InvalidInputError, match=f"got {FORMAT - 1}, wanted {FORMAT}"):
        begin(tmp_path, begun)


def test_the_depth_of_the_network_is_known_by_its_earlier_name(tmp_path: Path) -> None:
    (tmp_path / "begun.json").write_text(json.dumps({"format": FORMAT, "channels": 8, "levels": 1}))
    assert check_begun(tmp_path, {"channels": 8, "depth": 1})
    with pytest.raises(InvalidInputError, match="depth: got 0"):
        check_begun(tmp_path, {"channels": 8, "depth": 0})


def test_a_second_training_in_the_same_folder_is_refused(device: list[str], tmp_path: Path) -> None:
    with sole_writer(tmp_path), pytest.raises(InvalidInputError, match="another process"):
        run(*device, "--out", tmp_path)
    with sole_writer(tmp_path):
        pass


def test_what_a_training_is_of_is_what_was_there_when_it_began(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree, program = Path(provenance.__file__).resolve().parents[2], tmp_path / "programs" / "git"
    program.parent.mkdir()
    monkeypatch.setenv("PATH", str(program.parent))

    def another_process() -> dict[str, str]:
        provenance.commit.cache_clear()
        return provenance_of(tmp_path)

    def git_says(tree: object, commit: str, status: str = "") -> None:
        answers = f'case "$*" in *rev-parse*) printf "{tree}\\n{commit}" ;; *) printf "{status}" ;; esac'
        program.write_text(f"#!/bin/sh\n{answers}\n")
        program.chmod(0o755)

    try:
        git_says(tree, "abc")
        first = another_process()
        assert first["commit"] == "abc"
        assert "begun_at_commit" not in first
        git_says(tree, "abcd", " M train/fitting/fit.py")
        assert provenance_of(tmp_path)["commit"] == "abc"  # another commit while it works
        later = another_process()
        assert (later["commit"], later["begun_at_commit"]) == (f"abcd{provenance.CHANGED}", "abc")
        git_says("/elsewhere", "abc")
        assert "commit" not in another_process()
    finally:
        provenance.commit.cache_clear()
