"""`lightpage study`: every study makes its table and picture, is gone on with, and says what arithmetic says."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from analysis.studies import (
    STUDIES,
    angle,
    cross_section,
    drift,
    folding,
    imaging_condition,
    lens_path,
    pipe_length,
    rays,
    receptive_field,
    scaling,
)
from analysis.studies.command import study
from analysis.studies.study import Settings, aligned, measured
from analysis.studies.trained import chosen
from lightpage.device.lenses import LENSES
from lightpage.device.profile import load_profile
from lightpage.errors import InvalidInputError, ProfileError
from tests.lightpage.small import small_profile
from train.published.training import PublishedChoices

SMALL, BENCH, PAPER = small_profile(), load_profile("bench"), load_profile("paper")
SLOW = {name for name, study in STUDIES.items() if study.trains} - {"heads"} | {"drift"}
"""Four data sets are trained on, or the shipped decoder reads pages; heads trains in the same way, on one."""


def run(*arguments: object) -> str:
    words = [str(word) for word in arguments]
    return CliRunner().invoke(study, words, standalone_mode=False, catch_exceptions=False).output


@pytest.fixture
def small(tmp_path: Path) -> Path:
    (tmp_path / "small.toml").write_text(SMALL.to_toml())
    return tmp_path / "small.toml"


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.long] if n in SLOW else []) for n in STUDIES])
def test_each_makes_a_table_and_a_picture_and_is_gone_on_with(name: str, small: Path, tmp_path: Path) -> None:
    out, figures = tmp_path / "out", tmp_path / "F.json"
    arguments = (name, "--quick", "--profile", small, "--out", out)
    printed = run(*arguments, "--json", figures)
    written = json.loads(figures.read_text())
    assert len(written["rows"]) >= 1
    assert all(len(row) == len(written["header"]) for row in written["rows"])
    assert str(written["header"][0]) in printed
    assert STUDIES[name].title in (out / "table.txt").read_text()
    with Image.open(out / "figure.png") as figure:
        assert min(figure.size) > 200
    before = {path: path.stat().st_mtime_ns for path in (out / "results").iterdir()}
    run(*arguments)
    assert {path: path.stat().st_mtime_ns for path in (out / "results").iterdir()} == before
    for path in (out / "results").glob("*.npz") if STUDIES[name].trains else ():
        with np.load(path) as maps:
            result = json.loads(path.with_suffix(".json").read_text())["values"]
            assert float(np.nanmean(maps["air_map"])) == pytest.approx(result["air"], abs=1e-3)
            assert np.isnan(maps["own_mi_map"]).any()  # pilots carry nothing


def test_what_cannot_be_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    out = ("--out", tmp_path / "out")
    for words, named in (
        (("rays", "--full", "--profile", "bench", *out), "--full"),
        (("rays", "--out", ""), "--out"),
        (("rays", "--share", "0.5", *out), "--share"),
        (("rays", "--channels", "16", *out), "--channels"),
        (("angle", "--quick", "--channels", "16", *out), "--channels"),
        (("angle", "--full", *out), "CUDA"),
    ):
        with pytest.raises(InvalidInputError, match=named):
            run(*words)
    with pytest.raises(click.BadParameter, match="nan"):
        run("heads", "--share", "nan", *out)


def test_a_case_is_measured_once_and_comes_back_with_its_arrays(tmp_path: Path) -> None:
    settings, case = Settings(SMALL, quick=True), {"name": "square-diagonal", "shape": "square", "centroid": (1, 1)}
    told: list[str] = []
    first, again = (
        measured(cross_section.STUDY, settings, case, tmp_path, lambda what, share: told.append(what)) for _ in range(2)
    )
    assert told == ["trace"]
    np.testing.assert_array_equal(first["landed"], again["landed"])
    assert first["spots"] == again["spots"] == 1
    (tmp_path / "square-diagonal.npz").unlink()
    with pytest.raises(InvalidInputError, match=r"square-diagonal\.npz"):
        measured(cross_section.STUDY, settings, case, tmp_path, lambda what, share: None)
    for damaged in ("{", "{}", "[1]", '{"values": {}, "arrays": ["landed"]}'):
        (tmp_path / "square-diagonal.json").write_text(damaged)
        with pytest.raises(InvalidInputError, match=r"square-diagonal\.json"):
            measured(cross_section.STUDY, settings, case, tmp_path, lambda what, share: None)


def test_results_of_unknown_origin_are_not_taken_for_these(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ("imaging-condition", "--profile", small, "--out", out)
    run(*arguments, "--quick")
    begun = (out / "begun.json").read_text()
    with pytest.raises(InvalidInputError, match="quick"):
        run(*arguments)
    (out / "begun.json").unlink()
    with pytest.raises(InvalidInputError, match="unknown origin"):
        run(*arguments, "--quick", "--seed", "9")
    (out / "begun.json").write_text("[]")
    with pytest.raises(InvalidInputError, match=r"begun\.json"):
        run(*arguments, "--quick")
    (out / "begun.json").write_text(begun)
    shutil.rmtree(out / "results")
    (out / "results").write_text("")
    with pytest.raises(InvalidInputError, match="results"):
        run(*arguments, "--quick")


def test_a_table_lines_up() -> None:
    assert aligned(("a", "long"), [("x", 1.23456), ("yy", float("nan"))]) == " a   long\n x  1.235\nyy      -"


# ---- what they say --------------------------------------------------------------------------------------------------


def test_layers_see_what_strides_of_two_let_them() -> None:
    assert tuple(receptive_field.field_of_layers()) == receptive_field.EXPECTED


def test_single_pixels_are_too_fine_for_the_full_size_pipe_and_pairs_are_not() -> None:
    assert imaging_condition.needed_width_m(PAPER, 1) * 1e3 == pytest.approx(4.63, abs=0.01)
    assert imaging_condition.needed_width_m(PAPER, 2) < PAPER.pipe.width_m < imaging_condition.needed_width_m(PAPER, 1)


@pytest.mark.long  # fits a lens for seconds; the profile and the lens change seldom
def test_the_full_size_profile_states_the_path_that_is_traced_through_its_lens() -> None:
    found = lens_path.fitted_path(PAPER, LENSES["AC508-080-A"], seed=1)
    assert found.spread_rad > 1.5
    assert found.left_rad < 0.02
    for name, value in found.path.model_dump().items():
        assert getattr(PAPER.lens_path, name) == pytest.approx(value, abs=0.02), name


def test_a_square_pipe_makes_one_two_or_four_spots_and_a_round_one_smears(tmp_path: Path) -> None:
    settings = Settings(PAPER, quick=True)
    spots: dict[str, list[int]] = {"square": [], "round": []}
    for case in cross_section.STUDY.cases(settings):
        result = cross_section.STUDY.measure(settings, case, tmp_path, lambda what, share: None)
        spots[case["shape"]].append(result["spots"])
    assert set(spots["square"]) <= {1, 2, 4}
    assert max(spots["round"]) > 10


def test_a_square_pipe_lays_no_zone_on_another_and_a_sheared_one_does() -> None:
    settings, shared = Settings(BENCH), {}
    for case in rays.STUDY.cases(settings):
        result = rays.STUDY.measure(settings, case, Path(), lambda what, share: None)
        for _, x, y, _, share in rays.STUDY.rows([case], [result]):
            if x != "lost":
                shared[case["angle_deg"], x, y] = share
    assert max(share for (angle, _, _), share in shared.items() if angle == 0) == 0
    sheared = {(x, y): share for (angle, x, y), share in shared.items() if angle != 0}
    assert max(sheared, key=lambda zone: sheared[zone]) == (1, 1)  # the diagonal zones suffer most
    assert sheared[1, 1] > 0.03


def test_the_middle_of_a_picture_stays_and_no_ray_is_added() -> None:
    picture = folding.lettered_picture((112, 174))
    folded = folding.folded_by_rays(BENCH, picture, 0.0)
    assert folded.sum() == pytest.approx(picture.sum())
    border = tuple((large - small) // 2 for large, small in zip(folded.shape, picture.shape, strict=True))
    middle = (slice(40, 72), slice(60, 114))
    inside = folded[border[0] : border[0] + 112, border[1] : border[1] + 174]
    np.testing.assert_allclose(inside[middle], picture[middle])


def test_what_a_drift_costs_is_counted_over_all_pages_and_bundles_are_not_mixed() -> None:
    assert drift.recalibrate_at([(1.0, 0.99), (2.0, 0.97)], 0.98) == pytest.approx(1.5)
    assert drift.recalibrate_at([(1.0, 0.96)], 0.98) == pytest.approx(0.5)
    assert drift.recalibrate_at([(1.0, 0.999)], 0.98) is None
    evaluation = {"air_bits_per_symbol": 6.0, "pages": 3, "refused_pages": [{"page": 1}]}
    assert drift.air_of_all_pages(evaluation) == 4.5
    assert drift.air_of_all_pages({"pages": 0, "refused_pages": [{"page": 0}]}) == 0
    cases, still = drift.STUDY.cases(Settings(BENCH, quick=True)), np.zeros((4, 2))
    day = {"measured": still, "true": still, "distance": still[:, 0], "hours": np.linspace(0, 24, 4)}
    rates = [{"air": air, "bundle": "new"} for air in (6.0, 3.0)]
    assert drift.STUDY.rows(cases, [day, *rates])[-1][2] == 0.5
    with pytest.raises(InvalidInputError, match="new, old"):
        drift.STUDY.rows(cases, [day, rates[0], {"air": 3.0, "bundle": "old"}])


def test_enlarged_and_shortened_devices_have_the_zones_of_the_full_one() -> None:
    def ratio(profile: object) -> float:
        p = profile
        return p.page_width_m * p.pipe.length_m / p.lens.focal_length_m / p.pipe.width_m  # type: ignore[attr-defined]

    large = scaling.enlarged(BENCH, 2)
    assert large.page.columns * large.page.rows == 4 * BENCH.page.columns * BENCH.page.rows
    assert ratio(large) == pytest.approx(ratio(BENCH))
    assert ratio(load_profile("analysis/comparison/eighth.toml")) == pytest.approx(ratio(PAPER), rel=0.02)
    assert pipe_length.scaled_length_m(PAPER, 75) == pytest.approx(0.075)
    assert pipe_length.scaled_length_m(BENCH, 75) == pytest.approx(0.01875, rel=0.01)
    for profile, largest in ((BENCH, 8), (PAPER, 2)):
        assert max(case["factor"] for case in scaling.STUDY.cases(Settings(profile))) == largest
    with pytest.raises(ProfileError, match="16 times"):
        scaling.enlarged(PAPER, 16)


def test_a_study_trains_as_the_authors_did_unless_told_otherwise() -> None:
    curve = np.array([[10, 0.0], [20, 0.4], [30, 0.2], [40, 0.6]])
    assert angle.first_step(curve) == 20
    assert np.isnan(angle.first_step(curve, 0.7))
    assert chosen(Settings(SMALL), "ray", SMALL, 450) == PublishedChoices()
    smaller = chosen(Settings(SMALL, seed=3, share=0.1, channels=16), "mode", SMALL, 450, classes=16)
    assert smaller == PublishedChoices(channels=(16, 32), steps=1125, seed=3, classes=16)
