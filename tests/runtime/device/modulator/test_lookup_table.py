from pathlib import Path

import numpy as np
import pytest

from lightpage.device.profile import PageLayout
from lightpage.errors import InvalidInputError
from lightpage.runtime.commands.lookup_table import lookup_table
from lightpage.runtime.device.modulator.lookup_table import linear_table, read_table
from lightpage.runtime.device.modulator.screen.raster import Raster, ScreenSettings
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import bundle_path
from tests.lightpage.command import run
from tests.lightpage.small import small_profile
from tests.lightpage.uneven import OVERLAPPING, modulation


def table(tmp_path: Path, text: str, levels: int) -> list[int]:
    path = tmp_path / "table.csv"
    path.write_text(text)
    return read_table(path, levels).tolist()


def test_without_a_file_the_levels_lie_evenly_on_one_wave() -> None:
    assert linear_table(4).tolist() == [0, 64, 128, 192]
    assert linear_table(3).tolist() == [0, 85, 171]
    assert linear_table(256).tolist() == list(range(256))


@pytest.mark.parametrize(
    ("text", "greys"),
    [
        ("0,60,130,200\n", [0, 60, 130, 200]),
        ("# mine\ngrey\n0\n60 # second\n\n130;200", [0, 60, 130, 200]),
        ("phase_rad grey\n5 0\n2.5 100\n0 200\n", [200, 137, 74, 12]),  # counts from its lowest phase
        (f"phase_rad grey\n0 0\n{3 * np.pi / 4} 128\n{3 * np.pi / 2} 255\n", [0, 85, 170, 255]),  # just enough
        ("phase_rad, grey\n1, 0\n3, 50\n4.4, 100\n1.2, 200\n", [0, 39, 91, 143]),  # wrapped, and not linear
    ],
)
def test_a_file_states_grey_values_or_the_phases_of_some(text: str, greys: list[int], tmp_path: Path) -> None:
    assert table(tmp_path, text, 4) == greys


@pytest.mark.parametrize(
    ("text", "levels", "line", "got"),
    [
        ("", 4, "", "0 grey values"),
        ("0 1\n2 x", 4, "line 2", "'x'"),
        ("0 256", 2, "line 1", "256"),
        ("0 2.5", 2, "line 1", "2.5"),
        ("0 9 7 9", 4, "", "9 for levels 1 and 3"),
        ("phase_rad grey\n0 0\n1", 4, "line 3", "1"),
        ("phase_rad grey\n0 0\n2 100\n1.5 200\n", 4, "", "100 and 200"),
        ("phase_rad grey\n0 0\n2 100\n4 200\n", 4, "", "4 rad"),
        ("phase_rad grey\n0 0\n3 1\n6 2\n", 4, "", "levels 1 and 2"),
    ],
)
def test_a_wrong_file_is_told_by_its_line(text: str, levels: int, line: str, got: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError) as raised:
        table(tmp_path, text, levels)
    assert raised.value.subject == f"lookup table {tmp_path / 'table.csv'}" + (f", {line}" if line else "")
    assert got in raised.value.got
    with pytest.raises(InvalidInputError, match=r"^lookup table .*nowhere"):
        read_table(tmp_path / "nowhere.csv", 4)


TINY = small_profile().model_copy(update={"page": PageLayout(columns=3, rows=2, symbol_size_px=2)})
PAGE = np.array([[10, 20, 30], [40, 50, 60]], np.uint8)


def image(**settings: object) -> np.ndarray:
    values = {"rows_px": 8, "columns_px": 11, "background_grey": 1, **settings}
    return Raster(TINY, ScreenSettings.model_validate(values)).image(PAGE)


def test_each_symbol_is_a_square_and_the_page_lies_in_the_middle() -> None:
    shown = image()
    assert shown.dtype == np.uint8
    assert shown.shape == (8, 11)
    assert shown[2:6, 2:8].tolist() == 2 * [[10, 10, 20, 20, 30, 30]] + 2 * [[40, 40, 50, 50, 60, 60]]
    shown[2:6, 2:8] = 1
    assert (shown == 1).all()


def test_an_offset_moves_the_page_right_and_down_and_a_flip_mirrors_it_where_it_is() -> None:
    np.testing.assert_array_equal(image(offset_x_px=3, offset_y_px=-2), np.roll(image(), (-2, 3), (0, 1)))
    moved = {"columns_px": 10, "offset_x_px": 1}
    np.testing.assert_array_equal(image(flip_x=True, **moved)[:, 3:9], image(**moved)[:, 8:2:-1])
    np.testing.assert_array_equal(image(flip_y=True), image()[::-1])


@pytest.mark.parametrize(
    ("settings", "ends"), [({"columns_px": 5}, "-1"), ({"offset_y_px": 3}, "5"), ({"offset_x_px": -3}, "-1")]
)
def test_a_page_that_leaves_the_modulator_is_refused(settings: dict[str, int], ends: str) -> None:
    with pytest.raises(InvalidInputError, match=f"pixels {ends} to"):
        image(**settings)


@pytest.mark.parametrize("in_use", [None, "0 14 29 44 60 77 95 112 130 147 163 180 195 210 226 241"])
@pytest.mark.parametrize("levels", [None, 16])
def test_a_corrected_table_makes_the_levels_even(levels: int | None, in_use: str | None, tmp_path: Path) -> None:
    if in_use is not None and levels is None:
        return
    calibration = Bundle.open(bundle_path("bench")).calibration
    told = calibration.model_copy(update={"modulation": OVERLAPPING.as_dict()})
    told.save(tmp_path / "c.toml")
    (tmp_path / "in_use.csv").write_text(in_use or "")
    told_by = ["--calibration", tmp_path / "c.toml", "--out", tmp_path / "new.csv"]
    told_by += ["--levels", levels] if levels else []
    told_by += ["--in-use", tmp_path / "in_use.csv"] if in_use else []
    run(lookup_table, *told_by)
    greys = read_table(tmp_path / "new.csv", 16)
    known = np.arange(256) if in_use is None else read_table(tmp_path / "in_use.csv", 16)
    shown = np.interp(greys, known, OVERLAPPING.phase(2 * np.pi * np.arange(len(known)) / len(known)))
    # half a grey value is half of 2 pi / 256 times the slope, up to 1.5 here, and some more where the table bends
    assert np.abs(shown - shown[0] - 2 * np.pi * np.arange(16) / 16).max() < 1.2 * 1.5 * np.pi / 256
    calibration.save(tmp_path / "c.toml")
    with pytest.raises(InvalidInputError, match="even levels"):
        run(lookup_table, *told_by)


@pytest.mark.parametrize(("stroke", "sine", "levels"), [(-0.015, 0.15, 128), (-0.05, 0.0, 256)])
def test_levels_share_a_stroke_that_is_a_little_short(
    stroke: float, sine: float, levels: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    of = modulation(stroke_relative=stroke, phase_sin_1_rad=sine)
    calibration = Bundle.open(bundle_path("bench")).calibration
    calibration.model_copy(update={"modulation": of.as_dict()}).save(tmp_path / "c.toml")
    for options in ([], ["--levels", levels]):
        caplog.clear()
        run(lookup_table, "--calibration", tmp_path / "c.toml", "--out", tmp_path / "new.csv", *options)
        assert caplog.records
        greys = read_table(tmp_path / "new.csv", levels)
        steps = np.diff(of.phases(256)[greys])
        assert np.ptp(steps) < 2 * (1 + sine) * 2 * np.pi / 256  # each end is rounded by half a grey value
