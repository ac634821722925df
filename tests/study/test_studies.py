"""`lightpage study`: every study makes its table and picture, is gone on with, and says what arithmetic says."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError, MissingResultsError, ProfileError
from lightpage.study import STUDIES, angle, cross_section, pipe_length, scaling, tolerances
from lightpage.study.command import study
from lightpage.study.knobs import KNOBS
from lightpage.study.ours import split_for
from lightpage.study.study import Settings, measured
from lightpage.study.trained import chosen, split
from lightpage.train.published.training import PublishedChoices
from tests.lightpage.small import small_profile

SMALL, BENCH, PAPER = small_profile(), load_profile("bench"), load_profile("paper")
SLOW = {name for name, study in STUDIES.items() if study.trains} | {"drift", "tolerances"}
"""Data sets are trained on, or the shipped decoder reads pages; one piece of `paper` is trained below."""


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
    run(*arguments, "--json", figures)
    written = json.loads(figures.read_text())
    assert len(written["rows"]) >= 1
    assert all(len(row) == len(written["header"]) for row in written["rows"])
    with Image.open(out / "figure.png") as figure:
        assert min(figure.size) > 200
    before = {path: path.stat().st_mtime_ns for path in (out / "results").iterdir()}
    run(*arguments)
    assert {path: path.stat().st_mtime_ns for path in (out / "results").iterdir()} == before


def test_what_cannot_be_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    out = ("--out", tmp_path / "out")
    for words, named in (
        (("rays", "--full", "--profile", "bench", *out), "--full"),
        (("rays", "--out", ""), "--out"),
        (("rays", "--channels", "16", *out), "--channels"),
        (("angle", "--full", *out), "CUDA"),
        (("paper", "--compute", "cuda", *out), "--compute"),
        (("rays", "--compute", "cpu", *out), "trains nothing"),
        (("rays", "--set", "sensor.full_well_e=32", *out), "symbol-size"),
        (("rays", "--only", "ray", *out), "--only"),
        (("tolerances", "--only", "wobble", *out), "stroke, level"),
    ):
        with pytest.raises(InvalidInputError, match=named):
            run(*words)
        assert not (tmp_path / "out").exists()


def test_a_case_is_measured_once_and_comes_back_with_its_arrays(tmp_path: Path) -> None:
    case, told = {"name": "square-diagonal", "shape": "square", "centroid": (1, 1)}, list[str]()

    def again() -> Mapping[str, Any]:
        settings = Settings(SMALL, quick=True)
        return measured(cross_section.STUDY, settings, case, tmp_path, lambda what, share: told.append(what))

    first = again()
    np.testing.assert_array_equal(first["landed"], again()["landed"])
    assert told == ["trace"]
    (tmp_path / "square-diagonal.npz").unlink()
    with pytest.raises(InvalidInputError, match=r"square-diagonal\.npz"):
        again()
    (tmp_path / "square-diagonal.json").write_text("{}")
    with pytest.raises(InvalidInputError, match=r"square-diagonal\.json"):
        again()


def test_the_paper_goes_on_piece_by_piece_and_each_says_where_it_is_from(small: Path, tmp_path: Path) -> None:
    out, figures = tmp_path / "out", tmp_path / "F.json"
    every = ("paper", "--quick", "--profile", small, "--out", out, "--compute", "cpu")
    arguments = (*every, "--only", "ray-4x4", "--only", "bound")
    assert run(*arguments, "--left").split() == ["ray-4x4", "bound-4x4"]
    run(*arguments, "--json", figures)
    assert run(*every, "--left").split() == ["mode-4x4", "standard-4x4", "accurate-4x4", "rays"]
    with pytest.raises(InvalidInputError, match="changes"):
        run(*every, "--left", "--set", "sensor.full_well_e=32")
    kept, written = (json.loads(path.read_text()) for path in (out / "results/ray-4x4.json", figures))
    assert {"command", "machine", "time", "inputs"} <= set(kept["provenance"]) & set(written["provenance"])
    assert {"own_mi_map", "angles", "validation_curve"} <= set(kept["arrays"])
    row, bound = (dict(zip(written["header"], row, strict=True)) for row in written["rows"])
    assert (row["paper kB"], row["over the bound"]) == (25.0, row["AIR"] / bound["AIR"])
    assert 0 < bound["AIR"] < 8


def test_a_study_stops_in_time(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Over:
        def __init__(self, seconds: float, action: Callable[[], None]) -> None:
            assert seconds == 30
            self.start, self.cancel = action, lambda: None

    monkeypatch.setattr("threading.Timer", Over)
    with pytest.raises(MissingResultsError, match=r"0\.5 minutes"):
        run("rays", "--quick", "--profile", small, "--out", tmp_path / "out", "--minutes", "0.5")
    assert not list((tmp_path / "out/results").glob("*.json"))


def test_the_paper_is_done_in_the_order_of_worth() -> None:
    names = [case["name"] for case in STUDIES["paper"].cases(Settings(PAPER))]
    worth = "mode-4x4 ray-4x4 standard-4x4 accurate-4x4 bound-4x4 ray-2x2 rays ray-16x16 mode-75mm drift"
    assert " ".join(name for name in names if name in worth.split()) == worth
    assert len(set(names)) == len(names)


def test_more_pages_leave_the_same_ones_held_out() -> None:
    for pages in (148, 450, 1000):
        training, *held = split_for(Settings(SMALL), pages)
        assert len({*training} - {*held[0], *held[1]}) == len(training) == pages
        assert tuple(held) == split(Settings(SMALL))[1:]


def test_a_course_of_a_small_device_has_the_pixels_of_the_full_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(angle, "trained", lambda *given, **changes: (given[1], changes))
    small, names = Settings(SMALL), ["near-flat-1", "symbols-16-matched-0"]
    near, large = (angle.STUDY.measure(small, case, Path(), print) for case in angle.STUDY.chosen(small, names, Path()))
    assert near[0].device.geometry.pipe_angle_deg == pytest.approx(-4.8, rel=1e-3)
    assert near[1]["begins_rad"] == pytest.approx(0.8 * np.deg2rad(-4.8), rel=1e-3)
    assert (near[1]["seed"], near[1]["angle_rate"]) == (1, pytest.approx(8e-4, rel=1e-3))
    assert large[0].profile.page.symbol_size_px == 16


def test_enlarged_and_shortened_devices_have_the_zones_of_the_full_one() -> None:
    def ratio(of: Profile) -> float:
        return of.page_width_m * of.pipe.length_m / of.lens.focal_length_m / of.pipe.width_m

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


@pytest.mark.parametrize("name", KNOBS)
def test_a_knob_can_be_turned_as_far_as_it_is_measured(name: str) -> None:
    knob, device = KNOBS[name], Device()
    assert list(knob.values) == sorted({*knob.values} - {knob.at(device)})
    for value in knob.values:
        assert knob.at(knob.turned(device, value)) == pytest.approx(value)


def test_every_setting_of_a_device_has_a_knob_unless_it_is_known_why_not() -> None:
    settings = {f"{table}.{key}" for table, values in Device().model_dump().items() for key in values}
    left = settings - {key for knob in KNOBS.values() for key in knob.settings}
    followed, alike = {"drift.piston_rad", "drift.shift_px", "homodyne.quadrature_sign"}, {"slm.unmodulated_phase_rad"}
    of_others = {"sensor.bit_depth", "aberration.lens_path_relative_error"}  # more is no harm; of real lenses alone
    mended = {  # calibration names these, and no decoder is made for them
        "drift.vibration_rad",
        "reference.recorded_exposure_relative",
        "sensor.black_level_relative",
        "sensor.late_dust_specks",
        "slm.level_ripple_rad",
    }
    known = followed | alike | of_others | mended
    assert {key for key in left if not key.endswith("_seed") and "_y_" not in key} == known


def test_tolerances_say_within_which_range_a_tenth_of_a_bit_is_lost() -> None:
    knob, settings = KNOBS["modulator-axial"], Settings(SMALL)
    cases = tolerances.STUDY.chosen(settings, ["modulator-axial", "full-well"], Path("none"))
    assert [case["name"] for case in cases[:2]] == ["kept", "modulator-axial=-6"]
    lost = {1.5: 0.05, 3.0: 0.15, 6.0: 5.0, 1000.0: 0.02, 300.0: 0.18}
    airs = [6.3 - lost.get(case.get("value", 0), 0.0) for case in cases]
    results = [{"air": air, "told": 6.3, "anew": np.nan} for air in airs]
    device, axial, well = tolerances.STUDY.rows(cases, results)
    assert device[3:6] == ("6.30 bits", "", "6.30 bits")
    assert axial[3:] == ("<-6 to 2.2", "<-2.1 to 0.77 mm", "<-6 to >6", "-")
    assert well[3] == "550 to >100000"  # half way between 300 and 1000, in ratio
    assert knob.full_size is not None
    assert 1.2 * knob.full_size[0] == pytest.approx(0.41, abs=0.005)
    tilt = KNOBS["keystone"].full_size
    assert tilt is not None
    assert 0.0014 * tilt[0] == pytest.approx(1.0, abs=0.01)
    figure = tolerances.STUDY.plot(settings, cases, results)
    assert [axis.get_xlabel() for axis in figure.axes if axis.get_visible()] == [knob.unit, "electrons"]
