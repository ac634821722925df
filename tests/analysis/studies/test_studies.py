"""`lightpage study`: every study makes its table and picture, is gone on with, and says what arithmetic says."""

from __future__ import annotations

import json
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
    imaging_condition,
    pipe_length,
    rays,
    scaling,
)
from analysis.studies.command import study
from analysis.studies.study import Settings, measured
from analysis.studies.trained import chosen
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


# ---- what they say --------------------------------------------------------------------------------------------------


def test_single_pixels_are_too_fine_for_the_full_size_pipe_and_pairs_are_not() -> None:
    assert imaging_condition.needed_width_m(PAPER, 1) * 1e3 == pytest.approx(4.63, abs=0.01)
    assert imaging_condition.needed_width_m(PAPER, 2) < PAPER.pipe.width_m < imaging_condition.needed_width_m(PAPER, 1)


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
