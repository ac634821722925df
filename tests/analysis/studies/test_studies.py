"""Studies: what they measure, and that the command keeps what is done."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import click
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from PIL import Image
from torch.nn import functional

from analysis.studies import (
    STUDIES,
    angle,
    cross_section,
    drift,
    folding,
    heads,
    imaging_condition,
    lens_path,
    pipe_length,
    rays,
    receptive_field,
    scaling,
    symbol_size,
)
from analysis.studies.command import study
from analysis.studies.study import Settings, aligned, measured
from analysis.studies.trained import DataSet, _estimates, _of_classes, chosen
from lightpage.device.lenses import LENSES
from lightpage.device.profile import load_profile
from lightpage.device.state import Device, ideal_device
from lightpage.errors import InvalidInputError, ProfileError
from lightpage.simulator.recording_job import RecordingJob
from lightpage.simulator.true_optics import TrueOptics
from tests.lightpage.small import small_profile
from train.data.features import PageState
from train.published.decoder import PARAXIAL
from train.published.trainer import published_choices
from train.published.training import PublishedChoices

SMALL = small_profile()


def run(*arguments: str) -> str:
    return CliRunner().invoke(study, arguments, standalone_mode=False, catch_exceptions=False).output


@pytest.mark.parametrize("name", [name for name in STUDIES if not STUDIES[name].trains])
def test_each_makes_a_table_and_a_picture_and_is_gone_on_with(name: str, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL.to_toml())
    out = tmp_path / "out"
    arguments = (name, "--quick", "--profile", str(tmp_path / "small.toml"), "--out", str(out))
    printed = run(*arguments, "--json", str(tmp_path / "F.json"))
    written = json.loads((tmp_path / "F.json").read_text())
    assert len(written["rows"]) >= 1
    assert all(len(row) == len(written["header"]) for row in written["rows"])
    assert str(written["header"][0]) in printed
    assert STUDIES[name].title in (out / "table.txt").read_text()
    with Image.open(out / "figure.png") as figure:
        assert min(figure.size) > 200
    settings = Settings(SMALL, quick=True)
    cases = STUDIES[name].cases(settings)
    results = [measured(STUDIES[name], settings, case, out / "results", lambda what, share: None) for case in cases]
    assert all(axes.has_data() for axes in STUDIES[name].plot(settings, cases, results).axes)
    before = {path: path.stat().st_mtime_ns for path in (out / "results").iterdir()}
    run(*arguments)
    assert {path: path.stat().st_mtime_ns for path in (out / "results").iterdir()} == before
    with pytest.raises(InvalidInputError, match="quick"):
        run(name, "--profile", str(tmp_path / "small.toml"), "--out", str(out))


def test_what_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"--full.*--profile"):
        run("rays", "--full", "--profile", "bench", "--out", str(tmp_path / "out"))
    with pytest.raises(InvalidInputError, match="--out: got an empty name, wanted a folder"):
        run("rays", "--out", "")
    with pytest.raises(click.BadParameter, match="nan is not a finite number"):
        run("heads", "--share", "nan", "--out", str(tmp_path / "out"))
    with pytest.raises(InvalidInputError, match=r"--share.*trains nothing"):
        run("rays", "--share", "0.5", "--out", str(tmp_path / "out"))
    with pytest.raises(InvalidInputError, match=r"--channels.*trains nothing"):
        run("rays", "--channels", "16", "--out", str(tmp_path / "out"))
    with pytest.raises(InvalidInputError, match=r"--channels.*with --quick"):
        run("angle", "--quick", "--channels", "16", "--out", str(tmp_path / "out"))


def test_a_case_is_measured_once_and_comes_back_with_its_arrays(tmp_path: Path) -> None:
    settings, case = Settings(SMALL, quick=True), {"name": "square-diagonal", "shape": "square", "centroid": (1, 1)}
    told = []
    first = measured(cross_section.STUDY, settings, case, tmp_path, lambda what, share: told.append(what))
    again = measured(cross_section.STUDY, settings, case, tmp_path, lambda what, share: told.append(what))
    assert told == ["trace"]
    np.testing.assert_array_equal(first["landed"], again["landed"])
    assert first["spots"] == again["spots"] == 1
    (tmp_path / "square-diagonal.npz").unlink()
    with pytest.raises(InvalidInputError, match=r"arrays .*square-diagonal\.npz"):
        measured(cross_section.STUDY, settings, case, tmp_path, lambda what, share: told.append(what))
    for damaged in ("{", "{}", "[1]", '{"values": {}, "arrays": ["landed"]}'):
        (tmp_path / "square-diagonal.json").write_text(damaged)
        with pytest.raises(InvalidInputError, match=r"result .*square-diagonal\.json.*wanted a whole one"):
            measured(cross_section.STUDY, settings, case, tmp_path, lambda what, share: told.append(what))


def test_results_of_unknown_origin_are_not_taken_for_these(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL.to_toml())
    out = tmp_path / "out"
    arguments = ("imaging-condition", "--quick", "--profile", str(tmp_path / "small.toml"), "--out", str(out))
    run(*arguments)
    begun = (out / "begun.json").read_text()
    (out / "begun.json").unlink()
    with pytest.raises(InvalidInputError, match=r"study .*out: got results of unknown origin"):
        run(*arguments, "--seed", "9")
    for damaged in ("garbage", "[]"):
        (out / "begun.json").write_text(damaged)
        with pytest.raises(InvalidInputError, match=r"begun\.json: got .*wanted the JSON"):
            run(*arguments)
    (out / "begun.json").write_text(begun)
    run(*arguments)
    shutil.rmtree(out / "results")
    (out / "results").write_text("")
    with pytest.raises(InvalidInputError, match=r"results: got a file, wanted a folder"):
        run(*arguments)


def test_a_table_lines_up() -> None:
    assert aligned(("a", "long"), [("x", 1.23456), ("yy", float("nan"))]) == " a   long\n x  1.235\nyy      -"


def test_layers_see_what_strides_of_two_let_them() -> None:
    assert tuple(receptive_field.field_of_layers()) == receptive_field.EXPECTED


def test_single_pixels_are_too_fine_for_the_full_size_pipe_and_pairs_are_not() -> None:
    paper = load_profile("paper")
    assert imaging_condition.needed_width_m(paper, 1) * 1e3 == pytest.approx(4.63, abs=0.01)
    assert imaging_condition.needed_width_m(paper, 2) < paper.pipe.width_m < imaging_condition.needed_width_m(paper, 1)


def test_the_full_size_profile_states_the_path_that_is_traced_through_its_lens() -> None:
    paper = load_profile("paper")
    found = lens_path.fitted_path(paper, LENSES["AC508-080-A"], seed=1)
    assert found.spread_rad > 1.5
    assert found.left_rad < 0.02
    for name, value in found.path.model_dump().items():
        assert getattr(paper.lens_path, name) == pytest.approx(value, abs=0.02), name


def test_a_square_pipe_makes_one_two_or_four_spots_and_a_round_one_smears() -> None:
    paper = load_profile("paper")
    counts = {}
    for shape, trace in (("square", cross_section.square_exit), ("round", cross_section.round_exit)):
        for name, centroid in cross_section._POINTS.items():
            places, sines = cross_section.bundle(paper, centroid, 41)
            landed = trace(paper, places, sines) * paper.pipe.refractive_index * paper.lens.focal_length_m
            counts[shape, name] = cross_section.spots(landed, 0.02 * paper.pipe.width_m)
            # walls turn light, they neither steepen nor flatten it
            np.testing.assert_allclose(np.linalg.norm(trace(paper, places, sines), axis=1), np.linalg.norm(sines))
    square = [
        counts["square", name] for name in ("centre", "edge of a zone", "next zone", "corner of zones", "diagonal")
    ]
    assert square == [1, 2, 1, 4, 1]
    assert counts["round", "centre"] == 1
    assert min(counts["round", name] for name in cross_section._POINTS if name != "centre") > 10


def test_a_square_pipe_lays_no_zone_on_another_and_a_sheared_one_does() -> None:
    settings = Settings(load_profile("bench"))
    shared = {}
    for case in rays.STUDY.cases(settings):
        result = rays.STUDY.measure(settings, case, Path(), lambda what, share: None)
        for _, x, y, _, share in rays.STUDY.rows([case], [result]):
            if x != "lost":
                shared[case["angle_deg"], x, y] = share
    assert max(share for (angle, _, _), share in shared.items() if angle == 0) == 0
    # the diagonal zones suffer most
    sheared = {zone: share for (angle, *zone_), share in shared.items() if angle != 0 for zone in [tuple(zone_)]}
    assert max(sheared, key=lambda zone: sheared[zone]) == (1, 1)
    assert sheared[1, 1] > 0.03


def test_the_middle_of_a_picture_stays_and_its_neighbours_are_mirrored() -> None:
    bench = load_profile("bench")
    picture = folding.lettered_picture((112, 174))
    folded = folding.folded_by_rays(bench, picture, 0.0)
    assert folded.sum() == pytest.approx(picture.sum())  # rays are neither lost nor added
    border = folding._BORDER
    inside = folded[border:-border, border:-border]
    middle = (slice(40, 72), slice(60, 114))
    np.testing.assert_allclose(inside[middle], picture[middle])
    left = inside[40:72, 4:40]  # what lies there was written on the right, mirrored
    mirrored = picture[40:72, ::-1]
    best = max(np.corrcoef(left.ravel(), mirrored[:, k : k + 36].ravel())[0, 1] for k in range(60))
    assert best > 0.8


def test_crosshairs_tell_a_shift_of_the_image() -> None:
    profile = load_profile("bench")
    settings = Settings(profile, quick=True, seed=3)
    result = drift._crosshairs(settings, lambda what, share: None)
    assert result["measured"].shape == result["true"].shape == (6, 2)
    assert np.abs(result["measured"] - result["true"]).max() < 0.1
    assert np.linalg.norm(result["true"], axis=1).max() > 0.5
    # crosshairs that are found each with an error of its own are farther from the start than their mean
    of_mean = np.linalg.norm(result["measured"], axis=1)
    assert (result["distance"] >= of_mean).all()
    np.testing.assert_allclose(result["distance"], of_mean, atol=0.2)


def test_the_ground_between_crosshairs_is_dark() -> None:
    optics = TrueOptics(SMALL, Device())
    phases = drift.crosshair_phases(optics)
    assert 0.9 < np.mean(np.abs(np.diff(phases, axis=1)) > 1) < 1
    power = np.abs(optics.camera_field(optics.exit_field(phases))) ** 2
    assert np.median(power) < 0.02 * power.max()


def test_recalibration_is_due_where_the_air_crosses_the_limit() -> None:
    assert drift.recalibrate_at([(1.0, 0.99), (2.0, 0.97)], 0.98) == pytest.approx(1.5)
    assert drift.recalibrate_at([(1.0, 0.96)], 0.98) == pytest.approx(0.5)
    assert drift.recalibrate_at([(1.0, 0.999)], 0.98) is None


def test_a_turned_pipe_costs_the_shipped_decoder_some_of_its_rate(tmp_path: Path) -> None:
    settings = Settings(load_profile("bench"), quick=True)
    cases = drift.STUDY.cases(settings)[1:]
    rates = [drift.STUDY.measure(settings, case, tmp_path, lambda what, share: None)["air"] for case in cases]
    assert 5.5 < rates[0] < 7.5
    assert 0.5 * rates[0] < rates[1] < rates[0] - 0.02


def test_pages_that_are_refused_under_a_drift_carry_nothing() -> None:
    evaluation = {"air_bits_per_symbol": 6.0, "pages": 3, "refused_pages": [{"page": 1}]}
    assert drift.air_of_all_pages(evaluation) == 4.5
    assert drift.air_of_all_pages({"pages": 0, "refused_pages": [{"page": 0}]}) == 0


def test_figures_of_two_bundles_are_not_put_in_one_table() -> None:
    cases = drift.STUDY.cases(Settings(load_profile("bench"), quick=True))
    still = np.zeros((4, 2))
    day = {"measured": still, "true": still, "distance": still[:, 0], "hours": np.linspace(0, 24, 4)}
    of_one = [day, {"air": 6.0, "bundle": "new"}, {"air": 3.0, "bundle": "new"}]
    assert drift.STUDY.rows(cases, of_one)[-1][2] == 0.5
    with pytest.raises(InvalidInputError, match="of new, old, wanted of one bundle"):
        drift.STUDY.rows(cases, [*of_one[:2], {"air": 3.0, "bundle": "old"}])


def test_rays_that_are_lost_count_in_no_zone(tmp_path: Path) -> None:
    loses = SMALL.model_copy(update={"pipe": SMALL.pipe.model_copy(update={"refractive_index": 1.003})})
    settings = Settings(loses, quick=True)
    cases = rays.STUDY.cases(settings)
    results = [rays.STUDY.measure(settings, case, tmp_path, lambda what, share: None) for case in cases]
    for case, result in zip(cases, results, strict=True):
        rows = [row for row in rays.STUDY.rows(cases, results) if row[0] == f"{case['angle_deg']:g}"]
        lost = float(1 - result["valid"].mean())
        assert lost > 0.005
        assert (rows[-1][1], rows[-1][3]) == ("lost", pytest.approx(lost))
        assert sum(row[3] for row in rows) == pytest.approx(1)


def test_symbols_of_another_size_are_counted_whole(tmp_path: Path) -> None:
    settings, study = Settings(load_profile("bench")), imaging_condition.STUDY
    results = [study.measure(settings, case, tmp_path, lambda what, share: None) for case in study.cases(settings)]
    # 348 x 224 modulator pixels
    assert [result["symbols"] for result in results] == [348 * 224, 174 * 112, 87 * 56, 43 * 28, 21 * 14]


def test_an_enlarged_device_has_the_same_zones() -> None:
    bench, large = load_profile("bench"), scaling.enlarged(load_profile("bench"), 2)
    assert large.page.columns * large.page.rows == 4 * bench.page.columns * bench.page.rows
    ratio = [p.page_width_m * p.pipe.length_m / p.lens.focal_length_m / p.pipe.width_m for p in (bench, large)]
    assert ratio[0] == pytest.approx(ratio[1])


def test_a_matrix_that_does_not_fit_is_extrapolated_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(SMALL)
    cases = [case for case in scaling.STUDY.cases(settings) if case["method"] == "matrix"][:2]
    symbols = SMALL.page.columns * SMALL.page.rows
    monkeypatch.setattr(scaling, "_MOST_BYTES", 8 * symbols**2)
    monkeypatch.setattr(scaling.time, "perf_counter", itertools.count().__next__)  # whatever is timed takes a second
    results = [scaling.STUDY.measure(settings, case, tmp_path, lambda what, share: None) for case in cases]
    assert [result["how"] for result in results] == ["measured", "extrapolated"]
    assert [result["seconds"] for result in results] == [1, 16]
    assert [result["symbols"] for result in results] == [symbols, 4 * symbols]


@pytest.mark.parametrize(("name", "largest"), [("bench", 8), ("paper", 2)])
def test_devices_are_enlarged_to_some_three_hundred_thousand_symbols(name: str, largest: int) -> None:
    cases = scaling.STUDY.cases(Settings(load_profile(name)))
    assert max(case["factor"] for case in cases) == largest
    with pytest.raises(ProfileError, match="lenses 16 times as large"):
        scaling.enlarged(load_profile("paper"), 16)


DATA_SETS = {"angle": 2, "symbol-size": 2, "pipe-length": 2, "heads": 1}
"""How many recordings each study that trains asks for, its few cases."""


def test_all_that_train_are_known() -> None:
    assert {name for name, study in STUDIES.items() if study.trains} == set(DATA_SETS)


def test_the_first_step_above_a_threshold_is_told_or_none() -> None:
    curve = np.array([[10, 0.0], [20, 0.4], [30, 0.2], [40, 0.6]])
    assert angle.first_step(curve) == 20
    assert np.isnan(angle.first_step(curve, 0.7))
    assert np.isnan(angle.first_step(curve[:0]))


def test_the_device_for_studies_that_train_has_the_zones_of_the_full_one() -> None:
    eighth, paper = load_profile("analysis/comparison/eighth.toml"), load_profile("paper")
    ratio = [p.page_width_m * p.pipe.length_m / p.lens.focal_length_m / p.pipe.width_m for p in (eighth, paper)]
    assert ratio[0] == pytest.approx(ratio[1], rel=0.02)


@pytest.mark.parametrize(
    ("name", "data_sets"),
    [pytest.param(*each, marks=[] if each[0] == "heads" else pytest.mark.long) for each in DATA_SETS.items()],
)
def test_each_that_trains_makes_maps_of_every_case_and_each_data_set_once(
    name: str, data_sets: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "small.toml").write_text(SMALL.to_toml())
    out, made = tmp_path / "out", list[Path]()

    def made_and_noted(job: RecordingJob, pages: int, run: Callable[..., None] = RecordingJob.run) -> None:
        made.append(job.out)
        run(job, pages)

    monkeypatch.setattr(RecordingJob, "run", made_and_noted)
    run(name, "--quick", "--profile", str(tmp_path / "small.toml"), "--out", str(out))
    cases = STUDIES[name].cases(Settings(SMALL, quick=True))
    assert len(made) == len(set(made)) == data_sets  # several decoders on the same one
    assert list(out.glob("results/*.h5")) == made[-1:]
    written = json.loads((out / "study.json").read_text())
    assert len(written["rows"]) == len(cases)
    for case in cases:
        with np.load(out / "results" / f"{case['name']}.npz") as maps:
            result = json.loads((out / "results" / f"{case['name']}.json").read_text())["values"]
            assert float(np.nanmean(maps["air_map"])) == pytest.approx(result["air"], abs=1e-3)
            assert np.isnan(maps["own_mi_map"]).any()  # pilots carry nothing
            assert len(maps["validation_curve"]) > 1
            assert (len(maps["angles"]) > 0) == (case.get("localizer") == "ray")
            if len(maps["angles"]):
                assert result["angle_deg"] == pytest.approx(maps["angles"][-1, 1], abs=0.01)
                assert bool(maps["angles"][:, 1].any()) == (name != "pipe-length")  # whose pipes are known to be square


def test_posteriors_over_classes_are_made_calibrated_before_they_are_judged() -> None:
    classes, spread, shape = 4, 0.6, (40, 50)
    generator, mask = torch.Generator().manual_seed(0), np.zeros(shape, dtype=bool)
    mask[::10, ::10] = True

    def page() -> tuple[torch.Tensor, ...]:
        truth = torch.randint(classes, shape, generator=generator)
        observed = functional.one_hot(truth, classes).movedim(-1, 0).float()
        observed = observed + spread * torch.randn(observed.shape, generator=generator)
        return observed, torch.zeros(3), truth * (2 * np.pi / classes)

    def overconfident(by: float) -> SimpleNamespace:
        """Scores that claim the evidence of `by` as many observations."""
        network = SimpleNamespace(scores=lambda frames, shift: frames * by / spread**2)
        return SimpleNamespace(choices=PublishedChoices(classes=classes), network=network)

    validation, unseen = [page() for _ in range(4)], [page() for _ in range(8)]
    calibrated, loud = (_of_classes(overconfident(by), validation, unseen, mask) for by in (1.0, 3.0))  # type: ignore[arg-type]
    for found in (calibrated, loud):
        air, own = (float(np.nanmean(found[name])) for name in ("air_map", "own_mi_map"))
        assert own == pytest.approx(air, abs=0.03)
        assert found["ece"] < 0.02
    np.testing.assert_allclose(loud["air_map"], calibrated["air_map"], atol=1e-3)
    assert np.array_equal(np.isnan(calibrated["air_map"]), mask)


def test_a_share_of_the_steps_is_said_in_the_table(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL.to_toml())
    out = tmp_path / "out"
    run("symbol-size", "--quick", "--share", "0.5", "--profile", str(tmp_path / "small.toml"), "--out", str(out))
    assert "; 50% of the authors' steps" in (out / "table.txt").read_text()
    assert [row[-1] for row in json.loads((out / "study.json").read_text())["rows"]] == [6] * 4


def test_a_study_trains_as_the_authors_did_unless_told_otherwise() -> None:
    assert chosen(Settings(SMALL), "ray", SMALL, 450) == PublishedChoices()
    smaller = chosen(Settings(SMALL, seed=3, share=0.1, channels=16), "mode", SMALL, 450, classes=16)
    assert smaller == PublishedChoices(channels=(16, 32), steps=1125, seed=3, classes=16)


def test_what_trains_at_full_scale_asks_for_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(InvalidInputError, match="CUDA"):
        run("angle", "--full", "--out", str(tmp_path / "out"))


def test_a_smaller_device_has_a_shorter_pipe_with_as_many_walls() -> None:
    bench, paper = load_profile("bench"), load_profile("paper")
    assert pipe_length.scaled_length_m(paper, 75) == pytest.approx(0.075)
    assert pipe_length.scaled_length_m(bench, 75) == pytest.approx(0.01875, rel=0.01)
    assert pipe_length.LENGTHS_MM[-1] == 400


@pytest.mark.parametrize("study", [heads, pipe_length])
def test_square_pipes_without_defects_have_ideal_lenses_too(study: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[DataSet, dict[str, object]]] = []
    monkeypatch.setattr(
        study, "trained", lambda settings, data_set, localizer, *_, **changes: asked.append((data_set, changes))
    )
    settings = Settings(load_profile("paper"))
    for case in study.STUDY.cases(settings):
        study.STUDY.measure(settings, case, Path(), lambda what, share: None)
    assert {data_set.profile.ideal_lenses for data_set, _ in asked} == {True}
    assert all(data_set.device == ideal_device() for data_set, _ in asked)
    assert {published_choices("ray", data_set.profile, 450).lenses for data_set, _ in asked} == {PARAXIAL}
    if study is heads:  # classes know the piston, so the other head must
        assert {changes["knows_piston"] for _, changes in asked} == {True}


def test_a_known_piston_is_taken_off_as_it_is_and_not_as_pilots_show_it(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, shape = np.random.default_rng(0), (20, 30)
    mask = np.zeros(shape, dtype=bool)
    mask[::7, ::7] = True
    phases = rng.uniform(0, 2 * np.pi, (2, *shape)).astype(np.float32)
    seen = np.where(mask, 0.4, 0.0) + phases  # the pilots are misread, all in the same way
    states = [PageState((0.0, 0.0), piston) for piston in (0.7, -2.0)]
    turned = seen + np.array([state.piston_rad for state in states])[:, None, None]
    p = np.stack([np.cos(turned), np.sin(turned)], axis=1).astype(np.float32)
    monkeypatch.setattr("analysis.studies.trained.decode_pages", lambda *_: (p, phases))
    step = 2 * np.pi / 16  # classes learn the nearest one to a piston, and with it what is left over
    left_over = (0.7 - 2 * step, -2.0 + 5 * step)
    for knows_piston, classes, left in ((True, 0, (0.0, 0.0)), (False, 0, (-0.4, -0.4)), (True, 16, left_over)):
        module = SimpleNamespace(choices=SimpleNamespace(classes=classes))
        found, truth = _estimates(module, SimpleNamespace(states=states), mask, knows_piston)  # type: ignore[arg-type]
        off = np.angle((found[0] + 1j * found[1]) * np.exp(-1j * truth))
        np.testing.assert_allclose(off, np.broadcast_to(np.array(left)[:, None], off.shape), atol=1e-4)


def test_symbols_of_another_size_cover_the_same_page() -> None:
    bench = load_profile("bench")
    for size in symbol_size.SIZES_PX:
        other = bench.with_symbols_of(size)
        assert other.page_width_m == pytest.approx(bench.page_width_m, abs=16 * bench.slm.pitch_m)
        assert other.page.symbol_size_px == size
