"""`lightpage report`: every section of a run and of an evaluation, their figures, and what is refused."""

from __future__ import annotations

import html
import json
import math
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from analysis.report.command import report
from analysis.report.data import exit_centroids
from analysis.report.figures import training
from analysis.report.from_evaluation import report_of_evaluation
from analysis.report.from_run import levels_of, report_of_run, validation_pages
from analysis.report.json_file import JsonFile
from analysis.report.tables import geometry, zones
from export.command import export_run
from lightpage.errors import InvalidInputError, RecordingError
from lightpage.page.symbols import pilot_mask
from lightpage.recording.reader import Recording
from runtime.bundle.golden import in_few_counts
from runtime.commands.evaluate import evaluate
from runtime.decoding.decoder import Decoder
from tests.analysis.report.pages import check_whole, page_of, run
from tests.lightpage.small import small_profile
from train.commands.train import train
from train.fitting.curves import curves_of
from train.runs import load_run

SECTIONS = ["figures", "geometry", "maps", "zones", "reliability", "training", "page", "rays"]
DATA_SYMBOLS = int(np.count_nonzero(~pilot_mask(small_profile())))
STEPS = "12"
ROUNDING = 5e-5
"""Half of the last of four decimals, which is what maps in JSON are rounded to."""


@pytest.fixture(scope="module")
def coherent(small_device: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the decoder at symbol pitch."""
    out = tmp_path_factory.mktemp("coherent") / "run"
    small = ["--channels", "8", "--blocks", "1", "--steps", STEPS, "--synthetic-pages", "0"]
    run(train, *small_device, *small, "--validation-share", "0.25", "--test-share", "0.25", "--out", out)
    return out


@pytest.fixture(scope="module")
def ray(small_device: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the published decoder by rays."""
    out = tmp_path_factory.mktemp("ray") / "run"
    run(train, *small_device, "--localizer", "ray", "--channels", "4", "--steps", STEPS, "--out", out)
    return out


@pytest.fixture(scope="module")
def evaluation(coherent: Path, small_device: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The evaluation of the first run's bundle."""
    folder = tmp_path_factory.mktemp("evaluation")
    export_run(coherent, folder / "small.zip", version="small-1")
    run(evaluate, "--bundle", folder / "small.zip", "--recording", small_device[3], "--json", folder / "E.json")
    return folder / "E.json"


def test_a_run_at_symbol_pitch(coherent: Path, tmp_path: Path) -> None:
    text, seen = page_of(coherent, tmp_path / "R.html")
    check_whole(text, seen, SECTIONS)
    counts = {name: len(pictures) for name, pictures in seen.pictures.items()}
    assert counts == {"maps": 4, "reliability": 2, "training": 2, "page": 3, "rays": 4}
    assert "the validation pages of this run (2)" in text
    assert "8 channels, 1 blocks" in text


def test_the_steps_of_another_pass_are_counted_on() -> None:
    passes = [{"train_nll": [(4, 1.0), (9, 0.5)]}, {"train_nll": [(4, 0.4)]}]
    (loss,) = training(passes)
    assert "0.40 nat/symbol at step 14" in loss.alt


def test_a_run_of_two_passes_is_told_as_a_whole(coherent: Path) -> None:
    described, data = load_run(coherent), report_of_run(coherent)
    (first, second), facts = data.curves, dict(data.facts)
    best = max(value for _, value in second["val_air"])
    assert best == pytest.approx(described.validation_air, abs=0.02)  # looked at in bfloat16 while it trains
    _, air = training([first, second])
    assert f"with one more pass {best:.3f} bit/symbol" in air.caption
    weights = torch.load(coherent / "decoder.pt", weights_only=True)
    learnt = sum(value.numel() for name, value in weights.items() if name.startswith(("network.", "refiners.")))
    assert f"; {learnt:,} parameters in all" in facts["Network"]
    assert "; 1 more with 5 channels, 1 block;" in facts["Network"]
    assert facts["Training"].startswith("12 steps of 4 pages, 3 for each further pass, in ")


def test_a_run_by_rays_shows_the_angle_that_it_was_trained_to(
    ray: Path, small_device: list[str], tmp_path: Path
) -> None:
    text, seen = page_of(ray, tmp_path / "R.html", "--recording", small_device[3])
    check_whole(text, seen, SECTIONS)
    assert len(seen.pictures["training"]) == 3
    angle = np.rad2deg(torch.load(ray / "decoder.pt", weights_only=True)["localizer.angle"].item())
    data = report_of_run(ray, Path(small_device[3]))
    assert data.rays.angle_deg == pytest.approx(angle)
    assert data.rays.angle_deg != pytest.approx(data.calibration.angle_deg(data.profile))
    assert "its rays were trained to" in text


@pytest.mark.parametrize("name", ["coherent", "ray"])
def test_the_figures_of_a_run_are_those_of_its_training(
    name: str, small_device: list[str], request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(name)
    described = load_run(folder)
    # without the scale of its concentrations, the report decodes as training validated
    copy = shutil.copytree(folder, folder.with_name("unscaled"))
    text = json.loads((copy / "run.json").read_text()) | {"kappa_scale": 1.0}
    (copy / "run.json").write_text(json.dumps(text))
    plain = report_of_run(copy, Path(small_device[3]))
    assert plain.measures.air_bits_per_symbol == pytest.approx(described.validation_air, abs=1e-5)
    scaled = report_of_run(folder, Path(small_device[3]))
    assert abs(scaled.measures.over_claim_bits_per_symbol) < abs(plain.measures.over_claim_bits_per_symbol)


def test_a_published_run_is_decoded_with_the_states_of_its_validation_pages(
    ray: Path, small_device: list[str], tmp_path: Path
) -> None:
    copy, recording = shutil.copytree(ray, tmp_path / "run"), Path(small_device[3])
    own = report_of_run(ray, recording).maps.own_mi
    kept = json.loads((copy / "states.json").read_text())
    for page, changed in ((0, False), (-1, True)):
        kept["states"][page]["shift_px"] = [40.0, 0.0]
        (copy / "states.json").write_text(json.dumps(kept))
        assert np.array_equal(report_of_run(copy, recording).maps.own_mi, own, equal_nan=True) != changed


def test_maps_and_zones_add_up(coherent: Path) -> None:
    data = report_of_run(coherent)
    found = zones(data, exit_centroids(data.profile, data.calibration))
    assert len(found) > 1
    assert sum(zone.symbols for zone in found) == DATA_SYMBOLS == int(data.data.sum())
    mean = sum(zone.symbols * zone.air for zone in found) / DATA_SYMBOLS
    assert mean == pytest.approx(data.measures.air_bits_per_symbol, abs=1e-9)
    assert np.nanmean(data.maps.own_mi) == pytest.approx(data.measures.own_mi_bits_per_symbol, abs=1e-9)
    assert all(zone.worst_air < zone.air for zone in found)
    assert {zone.reflections for zone in found} == {(0, 0), (0, 1), (1, 0), (1, 1)}


def test_the_pipe_angle_is_told_in_degrees_with_what_is_nominal(coherent: Path) -> None:
    data = report_of_run(coherent)
    groups = dict(geometry(data))
    angle = groups["Pipe angle"][0]
    assert angle.unit == "degree"
    assert float(angle.value.replace("−", "-")) == pytest.approx(data.calibration.angle_deg(data.profile), abs=0.5)
    assert len(groups["In-phase camera"]) == 6
    assert sum(len(rows) for rows in groups.values()) == len(data.calibration.parameters)


def test_an_evaluation(evaluation: Path, tmp_path: Path) -> None:
    text, seen = page_of(evaluation, tmp_path / "E.html")
    check_whole(text, seen, SECTIONS)
    assert set(seen.pictures) == {"maps", "reliability", "page", "rays"}
    assert "an evaluation does not hold how its decoder was trained" in text
    assert "version small-1" in text


def test_an_evaluation_that_read_no_page(tmp_path: Path) -> None:
    path = tmp_path / "e.json"
    path.write_text(json.dumps({"pages": 0, "pages_left_out": 0, "refused_pages": [{"page": 0}]}))
    with pytest.raises(InvalidInputError, match="read no page"):
        report_of_evaluation(JsonFile.read(path))


def test_maps_of_an_evaluation_average_to_its_figures(evaluation: Path) -> None:
    found = json.loads(evaluation.read_text())
    maps = {name: np.array(rows, dtype=float) for name, rows in found["maps"].items()}
    assert np.array_equal(np.isnan(maps["air"]), pilot_mask(small_profile()))
    for name in ("air", "own_mi"):
        assert np.nanmean(maps[name]) == pytest.approx(found[f"{name}_bits_per_symbol"], abs=ROUNDING)
    assert 0 < np.nanmean(maps["error_rad"]) < np.pi
    bins = found["confidence_bins"]
    count = sum(part["count"] for part in bins)
    assert count == found["pages"] * found["symbols_per_page"]
    missed = sum(part["count"] * abs(part["accuracy"] - part["confidence"]) for part in bins)
    assert missed / count == pytest.approx(found["ece"])
    assert found["bundle"]["provenance"]["seed"] == 0


def test_a_golden_page_comes_from_the_bundle_that_was_evaluated_or_not_at_all(
    evaluation: Path, coherent: Path, tmp_path: Path
) -> None:
    shown = report_of_evaluation(JsonFile.read(evaluation)).golden
    own = report_of_run(coherent).golden
    assert not isinstance(shown, str)
    assert not isinstance(own, str)
    assert np.array_equal(shown.pair.in_phase, in_few_counts(own.pair, 8).in_phase)
    decoded = Decoder.load(evaluation.with_name("small.zip")).decode(shown.pair)
    network = decoded.phase + decoded.phase_error  # the report shows what the network says
    assert np.abs(np.exp(1j * shown.phase) - np.exp(1j * network)).max() < 0.01
    found = json.loads(evaluation.read_text())
    moved = tmp_path / "E.json"
    found["bundle"]["path"] = str(tmp_path / "gone.zip")
    moved.write_text(json.dumps(found))
    text, seen = page_of(moved, tmp_path / "E.html")
    assert "bundle gone.zip can no longer be read" in text
    assert "page" not in seen.pictures
    shutil.copy(evaluation.with_name("small.zip"), tmp_path / "gone.zip")
    found["bundle"]["golden_sha256"] = "0" * 64
    moved.write_text(json.dumps(found))
    assert "is not the bundle that was evaluated" in str(report_of_evaluation(JsonFile.read(moved)).golden)


def test_text_from_files_is_escaped(coherent: Path, evaluation: Path, tmp_path: Path) -> None:
    evil = '<script>alert("1")</script>'
    shutil.copytree(coherent, tmp_path / "run")
    described = json.loads((tmp_path / "run" / "run.json").read_text())
    described["provenance"]["command"] = evil
    (tmp_path / "run" / "run.json").write_text(json.dumps(described))
    found = json.loads(evaluation.read_text())
    found["bundle"]["name"] = found["bundle"]["provenance"]["commit"] = evil
    (tmp_path / "E.json").write_text(json.dumps(found))
    for source in (tmp_path / "run", tmp_path / "E.json"):
        text, seen = page_of(source, tmp_path / "R.html")
        assert "script" not in seen.tags
        assert html.escape(evil).replace("&quot;", "&#34;") in text


def test_curves_that_are_gone_are_said_to_be_gone(coherent: Path, tmp_path: Path) -> None:
    curves = curves_of(coherent)
    assert curves["val_air"][-1][0] < int(STEPS)
    shutil.copytree(coherent, tmp_path / "run", ignore=shutil.ignore_patterns("tensorboard"))
    _, seen = page_of(tmp_path / "run", tmp_path / "R.html")  # from what the finished training kept
    assert seen.sections == SECTIONS
    assert "training" in seen.pictures
    (tmp_path / "run" / "fitted.json").unlink()
    text, seen = page_of(tmp_path / "run", tmp_path / "R.html")
    assert seen.sections == SECTIONS
    assert "training" not in seen.pictures
    assert "the run did not keep them" in text


def test_levels_are_read_off_phases() -> None:
    for levels in (2, 16, 100, 256):
        drawn = np.random.default_rng(levels).integers(levels, size=2000)
        assert levels_of((drawn * (2 * np.pi / levels)).astype(np.float32)) == levels
    with pytest.raises(InvalidInputError, match="at most 256 levels"):
        levels_of(np.random.default_rng(0).uniform(0, 6, 100).astype(np.float32))


def test_validation_pages_are_found_in_the_recording(coherent: Path, small_device: list[str], tmp_path: Path) -> None:
    shutil.copy(small_device[3], wide := tmp_path / "wide.h5")
    with h5py.File(wide, "r+") as file:
        for name in ("in_phase", "quadrature"):
            counts = file[name][()]
            assert counts.dtype == np.uint8
            del file[name]
            file[name] = counts.astype(np.uint16)
    for path in (small_device[3], wide):
        with Recording.open(path) as recording:
            assert validation_pages(load_run(coherent), recording) == [4, 5]


def test_what_is_no_source_is_refused(
    coherent: Path, ray: Path, evaluation: Path, small_device: list[str], tmp_path: Path
) -> None:
    out = tmp_path / "R.html"
    (tmp_path / "unfinished").mkdir()
    (tmp_path / "notes.txt").write_text("AIR was fine")
    (tmp_path / "other.json").write_text(json.dumps({"bundle_version": "1", "pages": 3}))
    found = json.loads(evaluation.read_text())
    found["maps"]["air"] = found["maps"]["air"][:-1]
    (tmp_path / "short.json").write_text(json.dumps(found))
    bad = {"confidence_bins": [], "pages": -1, "air_bits_per_symbol": 1e308, "ece": math.nan}
    for name, value in bad.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(json.loads(evaluation.read_text()) | {name: value}))
    for source, named in (
        (tmp_path / "unfinished", r"unfinished: got .*wanted a finished training run"),
        (
            tmp_path / "notes.txt",
            r"notes.txt: got text that is no JSON.*wanted a finished training run, a bulk run",
        ),
        (tmp_path / "other.json", r"other.json: got pages_left_out \(Field required\).* more, wanted"),
        (tmp_path / "short.json", r"maps: got 27 rows of \[44\] symbols, wanted 28 rows of 44"),
        *((tmp_path / f"{name}.json", rf"{name}\.json: got {name} \(.*wanted a finished training run") for name in bad),
        (ray, r"--recording: got none, wanted the recording of the run.*ray"),
    ):
        with pytest.raises(InvalidInputError, match=named):
            run(report, source, "--out", out)
    with pytest.raises(InvalidInputError, match=r"--recording: got .*none with the JSON of `lightpage evaluate`"):
        run(report, evaluation, "--out", out, "--recording", small_device[3])
    shutil.copytree(coherent, tmp_path / "bare", ignore=shutil.ignore_patterns("features"))
    with pytest.raises(InvalidInputError, match=r"features: got No such file.*that training left"):
        run(report, tmp_path / "bare", "--out", out)
    assert not out.exists()


def test_a_recording_of_another_device_is_refused(
    ray: Path, coherent: Path, small_device: list[str], bench_recording: Path, tmp_path: Path
) -> None:
    out, other = tmp_path / "R.html", tmp_path / "other.h5"
    shutil.copy(small_device[3], other)
    with h5py.File(other, "r+") as file:
        file["in_phase"][...] = file["in_phase"][...] // 2
    for folder in (ray, coherent):
        with pytest.raises(
            RecordingError, match=r"got 0 of \d validation pages, wanted the recording that the run was"
        ):
            run(report, folder, "--out", out, "--recording", other)
        with pytest.raises(RecordingError, match="pixels"):
            run(report, folder, "--out", out, "--recording", bench_recording)
    assert not out.exists()
