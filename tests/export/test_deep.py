"""Deep recalibration: what it needs, and that a drifted device reads better after it than after a re-fit alone."""

import json
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from unittest.mock import Mock

import pytest

from lightpage.calibration.document import Calibration
from lightpage.cli.main import run as run_command
from lightpage.cli.simulate import simulate
from lightpage.errors import CalibrationError, InvalidInputError
from lightpage.export import device_geometry
from lightpage.export.deep import DEEP
from lightpage.runtime.archives.workers.fine_tuning import GROUP, deep_recalibration
from lightpage.runtime.commands.archives.bulk import bulk
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.train.commands.train import train
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.runs import WEIGHTS, Run
from tests.lightpage.command import run
from tests.lightpage.small import UNEXPLAINED, small_profile
from tests.runtime import toy

TRAINED = ("1" * 64,)


def made_run(folder: Path, profile_toml: str) -> Path:
    folder.mkdir()
    Run("coherent", profile_toml, "", Hyperparameters(), 8, TRAINED, 0.0, 1.0, 0.0).save(folder)
    (folder / WEIGHTS).touch()
    return folder


def test_the_entry_point_names_it() -> None:
    release = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))
    ((name, value),) = release["project"]["entry-points"][GROUP].items()
    assert EntryPoint(name, value, GROUP).load() is deep_recalibration() is DEEP


def test_a_device_without_what_it_needs_is_told(tmp_path: Path) -> None:
    bundle = toy.write_toy_bundle(tmp_path / "toy.zip", trained_pages=TRAINED)
    own = Bundle.open(bundle).manifest.profile
    good, other = made_run(tmp_path / "good", own), made_run(tmp_path / "other", small_profile().to_toml())
    DEEP.check(bundle, good, 8)
    stranger = toy.write_toy_bundle(tmp_path / "stranger.zip")
    for model, trained, pages, told in (
        (bundle, None, 40, "^run"),
        (bundle, good, 7, "known pages"),
        (bundle, tmp_path / "none", 40, "none"),
        (bundle, other, 40, "profile small"),
        (stranger, good, 40, r"stranger\.zip"),
    ):
        with pytest.raises(InvalidInputError, match=told):
            DEEP.check(model, trained, pages)


def test_a_wrong_geometry_found_from_nominal_is_refused(
    small_bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder = Decoder.load(small_bundle, threads=1)
    wrong = decoder.bundle.calibration.model_copy(update={"goodness": UNEXPLAINED})
    for name in ("calibrate", "known_pages", "read_recorded"):
        monkeypatch.setattr(device_geometry, name, Mock())
    monkeypatch.setattr(device_geometry, "refit", Mock(side_effect=CalibrationError("re-fit", "wrong", "good")))
    monkeypatch.setattr(Calibration, "from_registered", Mock(return_value=wrong))
    with pytest.raises(CalibrationError):
        device_geometry.device_geometry(decoder, Mock(), [0], tmp_path / "kept", lambda what, share: None)
    assert not (tmp_path / "kept").exists()


@pytest.mark.long  # trains twice and exports twice; what it is made of is tested by itself
def test_a_drifted_device_is_found_trained_on_and_judged_by_pages_of_its_own(
    small_device: list[str], tmp_path: Path
) -> None:
    from lightpage.export.from_run import export_run

    small = [*small_device, "--channels", "8", "--blocks", "1", "--refinements", "0", "--synthetic-pages", "0"]
    run(train, *small, "--steps", 240, "--out", tmp_path / "run")
    export_run(tmp_path / "run", tmp_path / "bundle.zip", version="small-1")
    drifted = ["--set", "geometry.pipe_angle_deg=-0.58", "--set", "in_phase_camera.shift_x_px=5"]
    for name, pages, seed in (("a", 6, 31), ("b", 6, 32)):
        words = [*small_device[:2], "--pages", pages, "--seed", seed, *drifted, "--no-truth"]
        run(simulate, *words, "--out", tmp_path / f"{name}.h5")
    lines = ["[[device]]", 'name = "a"', 'bundle = "bundle.zip"', 'recordings = ["a.h5", "b.h5"]', 'run = "run"']
    (tmp_path / "fleet.toml").write_text("\n".join(lines))
    words = ["recalibrate", str(tmp_path / "out"), "--fleet", str(tmp_path / "fleet.toml"), "--workers", "1"]
    deep = ["--deep", "--steps", "120", "--json", str(tmp_path / "J.json")]
    assert run_command(bulk, [*words, *deep]) == 0
    (row,) = json.loads((tmp_path / "J.json").read_text())["devices"]
    assert row["air_after"] > row["air_before"] + 0.1
    assert (row["pages_used"], row["pages_held_back"]) == (12, 2)
    made, before = Bundle.open(row["bundle"]), Bundle.open(tmp_path / "bundle.zip")
    assert made.version == "small-1+r1"
    assert set(before.manifest.trained_pages) < set(made.manifest.trained_pages)
    assert len(set(made.manifest.trained_pages) - set(before.manifest.trained_pages)) == 10
    assert made.manifest.provenance.command == "recalibrate --deep from small-1"
