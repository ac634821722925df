"""`lightpage report`: every section of a run and of an evaluation, their figures, and what is refused."""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from lightpage.errors import InvalidInputError, RecordingError
from lightpage.page.levels import Levels
from lightpage.page.symbols import pilot_mask
from lightpage.report.command import report
from lightpage.report.contents.from_evaluation import report_of_evaluation
from lightpage.report.contents.from_run import levels_of, report_of_run
from lightpage.report.json_file import JsonFile
from lightpage.report.tables import geometry, zones
from lightpage.report.traced import exit_centroids
from lightpage.runtime.commands.archives.evaluate import evaluate
from lightpage.runtime.model.bundle.bundle import in_few_counts
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.train.runs import load_run
from tests.lightpage.command import run
from tests.lightpage.small import small_profile
from tests.lightpage.uneven import UNEVEN, uneven
from tests.report.pages import check_whole, page_of

SECTIONS = ["figures", "geometry", "maps", "zones", "reliability", "training", "page", "rays"]
DATA_SYMBOLS = int(np.count_nonzero(~pilot_mask(small_profile())))
ROUNDING = 5e-5
"""Half of the last of four decimals, which is what maps in JSON are rounded to."""


@pytest.fixture(scope="module")
def evaluation(small_bundle: Path, small_device: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("evaluation") / "E.json"
    run(evaluate, "--bundle", small_bundle, "--recording", small_device[3], "--json", out)
    return out


def changed(source: Path, out: Path, **values: Any) -> Path:
    """A copy of JSON with other values."""
    out.write_text(json.dumps(json.loads(source.read_text()) | values))
    return out


def test_a_run_of_two_passes(small_run: Path, tmp_path: Path) -> None:
    text, seen = page_of(small_run, tmp_path / "R.html")
    check_whole(text, seen, SECTIONS)
    counts = {name: len(pictures) for name, pictures in seen.pictures.items()}
    assert counts == {"geometry": 1, "maps": 4, "reliability": 2, "training": 2, "page": 3, "rays": 4}
    data, described = report_of_run(small_run), load_run(small_run)
    facts = dict(data.facts)
    weights = torch.load(small_run / "decoder.pt", weights_only=True)
    learnt = sum(value.numel() for name, value in weights.items() if name.startswith(("network.", "refiners.")))
    assert f"{learnt:,} parameters" in facts["Network"]
    best = max(value for _, value in data.curves[1]["val_air"])
    assert best == pytest.approx(described.validation_air, abs=0.02)  # looked at in bfloat16 while it trains


def test_a_run_by_rays_shows_the_angle_that_it_was_trained_to(
    ray_run: Path, small_device: list[str], tmp_path: Path
) -> None:
    text, seen = page_of(ray_run, tmp_path / "R.html", "--recording", small_device[3])
    check_whole(text, seen, SECTIONS)
    assert len(seen.pictures["training"]) == 3
    angle = np.rad2deg(torch.load(ray_run / "decoder.pt", weights_only=True)["localizer.angle"].item())
    data = report_of_run(ray_run, Path(small_device[3]))
    assert data.rays.angle_deg == pytest.approx(angle)
    assert data.rays.angle_deg != pytest.approx(data.calibration.angle_deg(data.profile))


@pytest.mark.parametrize("name", ["small_run", "ray_run"])
def test_the_figures_of_a_run_are_those_of_its_training(
    name: str, small_device: list[str], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(name)
    # without the scale of its concentrations, the report decodes as training validated
    copy = shutil.copytree(folder, tmp_path / "unscaled")
    changed(folder / "run.json", copy / "run.json", kappa_scale=1.0)
    plain = report_of_run(copy, Path(small_device[3])).measures
    assert plain.air_bits_per_symbol == pytest.approx(load_run(folder).validation_air, abs=1e-5)
    scaled = report_of_run(folder, Path(small_device[3])).measures
    assert abs(scaled.over_claim_bits_per_symbol) < abs(plain.over_claim_bits_per_symbol)


def test_zones_add_up_and_the_pipe_angle_is_told_in_degrees(small_run: Path) -> None:
    data = report_of_run(small_run)
    found = zones(data, exit_centroids(data.profile, data.calibration))
    assert sum(zone.symbols for zone in found) == DATA_SYMBOLS == int(data.data.sum())
    mean = sum(zone.symbols * zone.air for zone in found) / DATA_SYMBOLS
    assert mean == pytest.approx(data.measures.air_bits_per_symbol, abs=1e-9)
    assert np.nanmean(data.maps.own_mi) == pytest.approx(data.measures.own_mi_bits_per_symbol, abs=1e-9)
    assert all(zone.worst_air < zone.air for zone in found)
    assert {zone.reflections for zone in found} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    (angle,) = dict(geometry(data))["Pipe angle"]
    assert float(angle.value.replace("−", "-")) == pytest.approx(data.calibration.angle_deg(data.profile), abs=0.5)


def test_an_evaluation_and_its_maps(evaluation: Path, tmp_path: Path) -> None:
    text, seen = page_of(evaluation, tmp_path / "E.html", "--json", tmp_path / "J")
    check_whole(text, seen, ["drift" if name == "training" else name for name in SECTIONS])
    assert json.loads((tmp_path / "J").read_text())["bytes"] == len(text.encode())
    found = json.loads(evaluation.read_text())
    maps = {name: np.array(rows, dtype=float) for name, rows in found["maps"].items()}
    assert np.array_equal(np.isnan(maps["air"]), pilot_mask(small_profile()))
    for name in ("air", "own_mi"):
        assert np.nanmean(maps[name]) == pytest.approx(found[f"{name}_bits_per_symbol"], abs=ROUNDING)


def test_an_evaluation_is_shown_without_torch_all_but_what_is_traced(evaluation: Path, tmp_path: Path) -> None:
    script = f"""
import sys
sys.modules.update(dict.fromkeys(["torch", "tensorboard", "lightning"]))  # as if they were not there
from lightpage.cli.main import lightpage, run
sys.exit(run(lightpage, ["report", {str(evaluation)!r}, "--out", {str(tmp_path / "E.html")!r}]))
"""
    assert subprocess.run([sys.executable, "-c", script], timeout=120).returncode == 0
    text = (tmp_path / "E.html").read_text("utf-8")
    assert text.count("lightpage[train]") == 2  # zones and rays


def test_a_golden_page_comes_from_the_bundle_that_was_evaluated_or_not_at_all(
    evaluation: Path, small_bundle: Path, small_run: Path, tmp_path: Path
) -> None:
    shown, own = report_of_evaluation(JsonFile.read(evaluation)).golden, report_of_run(small_run).golden
    assert not isinstance(shown, str)
    assert not isinstance(own, str)
    assert np.array_equal(shown.pair.in_phase, in_few_counts(own.pair, 8).in_phase)
    decoded = Decoder.load(small_bundle).decode(shown.pair)
    network = decoded.phase + decoded.phase_error  # the report shows what the network says
    assert np.abs(np.exp(1j * shown.phase) - np.exp(1j * network)).max() < 0.01
    told = json.loads(evaluation.read_text())["bundle"] | {"path": str(tmp_path / "gone.zip")}
    moved = changed(evaluation, tmp_path / "E.json", bundle=told)
    assert isinstance(report_of_evaluation(JsonFile.read(moved)).golden, str)
    assert "page" not in page_of(moved, tmp_path / "E.html")[1].pictures
    shutil.copy(small_bundle, tmp_path / "gone.zip")
    moved = changed(moved, moved, bundle=told | {"golden_sha256": "0" * 64})
    assert isinstance(report_of_evaluation(JsonFile.read(moved)).golden, str)


def test_levels_are_read_off_phases() -> None:
    for levels in (2, 16, 100, 256):
        drawn = np.random.default_rng(levels).integers(levels, size=2000)
        assert levels_of((drawn * (2 * np.pi / levels)).astype(np.float32)) == Levels(levels)
        shown = uneven(levels)
        assert levels_of(shown.phases[drawn].astype(np.float32), UNEVEN) == shown
    with pytest.raises(InvalidInputError, match="256"):
        levels_of(np.random.default_rng(0).uniform(0, 6, 100).astype(np.float32))


def test_what_is_no_source_is_refused(
    small_run: Path, ray_run: Path, evaluation: Path, small_device: list[str], tmp_path: Path
) -> None:
    (tmp_path / "notes.txt").write_text("AIR was fine")
    (tmp_path / "other.json").write_text(json.dumps({"bundle_version": "1", "pages": 3}))
    (tmp_path / "none.json").write_text(json.dumps({"pages": 0, "pages_left_out": 0, "refused_pages": [{"page": 0}]}))
    bare = shutil.copytree(small_run, tmp_path / "bare", ignore=shutil.ignore_patterns("features"))
    maps = json.loads(evaluation.read_text())["maps"]
    bad = {"confidence_bins": [], "pages": -1, "air_bits_per_symbol": 1e308, "ece": math.nan}
    bad |= {"maps": maps | {"air": maps["air"][:-1]}}
    recording: tuple[object, ...] = ("--recording", small_device[3])
    for source, options, named in (
        *((tmp_path / name, (), name) for name in ("notes.txt", "other.json", "none.json")),
        *((changed(evaluation, tmp_path / f"{n}.json", **{n: value}), (), n) for n, value in bad.items()),
        (ray_run, (), "--recording"),
        (evaluation, recording, "--recording"),
        (bare, (), "features"),
    ):
        with pytest.raises(InvalidInputError, match=named):
            run(report, source, "--out", tmp_path / "R.html", *options)
    assert not (tmp_path / "R.html").exists()


def test_a_recording_of_another_device_is_refused(
    ray_run: Path, small_run: Path, small_device: list[str], tmp_path: Path
) -> None:
    shutil.copy(small_device[3], other := tmp_path / "other.h5")
    with h5py.File(other, "r+") as file:
        file["in_phase"][...] = file["in_phase"][...] // 2
    for folder in (ray_run, small_run):
        with pytest.raises(RecordingError, match="validation pages"):
            run(report, folder, "--out", tmp_path / "R.html", "--recording", other)
