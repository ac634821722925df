from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import InvalidInputError, PageError
from runtime.modulator.lookup_table import LookupTable


def table(tmp_path: Path, text: str, levels: int) -> list[int]:
    path = tmp_path / "table.csv"
    path.write_text(text)
    return [int(grey) for grey in LookupTable.from_file(path, levels).greys]


def test_without_a_file_the_levels_lie_evenly_on_one_wave() -> None:
    assert LookupTable.linear(4).greys.tolist() == [0, 64, 128, 192]
    assert LookupTable.linear(3).greys.tolist() == [0, 85, 171]
    assert LookupTable.linear(256).greys.tolist() == list(range(256))
    with pytest.raises(PageError):
        LookupTable.linear(1)


@pytest.mark.parametrize("text", ["0 60 130 200", "0,60,130,200\n", "# mine\ngrey\n0\n60 # second\n\n130;200"])
def test_a_file_of_grey_values_is_taken_as_it_is(text: str, tmp_path: Path) -> None:
    assert table(tmp_path, text, 4) == [0, 60, 130, 200]


def test_a_calibration_gives_the_grey_values_whose_phases_are_the_levels(tmp_path: Path) -> None:
    """A modulator whose phase is not linear: 2.2 waves x^1.5 over its grey values, stated every 5th, wrapped."""

    def phase(grey: np.ndarray) -> np.ndarray:
        return 2.2 * 2 * np.pi * (grey / 255) ** 1.5 + 0.4

    greys = np.arange(0, 256, 5)
    text = "phase_rad grey\n" + "".join(
        f"{p % (2 * np.pi):.6f}, {g}\n" for p, g in zip(phase(greys), greys, strict=True)
    )
    found = np.array(table(tmp_path, text, 16))
    slope = np.abs(np.gradient(phase(np.arange(256.0)))).max()  # half a grey value of rounding, and the interpolation
    assert np.abs(phase(found) - phase(np.zeros(1)) - 2 * np.pi * np.arange(16) / 16).max() < 0.6 * slope


def test_a_phase_that_falls_with_the_grey_value_counts_from_its_lowest(tmp_path: Path) -> None:
    assert table(tmp_path, "phase_rad grey\n5 0\n2.5 100\n0 200\n", 4) == [200, 137, 74, 12]


@pytest.mark.parametrize(
    ("text", "levels", "line", "got"),
    [
        ("", 4, "", "0 grey values"),
        ("0 1 2", 4, "", "3 grey values"),
        ("0 1\n2 x", 4, "line 2", "'x'"),
        ("0 nan", 2, "line 1", "'nan'"),
        ("0 256", 2, "line 1", "256"),
        ("-1 2", 2, "line 1", "-1"),
        ("0 2.5", 2, "line 1", "2.5"),
        ("0 9 7 9", 4, "", "9 for levels 1 and 3"),
        ("phase_rad grey\n", 4, "", "0 grey values"),
        ("phase_rad grey\n0 0", 4, "", "1 grey values"),
        ("phase_rad grey\n0 0\n1", 4, "line 3", "1"),
        ("phase_rad grey\n0 0\n1 300", 4, "line 3", "300"),
        ("phase_rad grey\n0 0\n1 0", 4, "line 3", "0"),
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


def test_a_calibration_that_spans_just_enough_is_taken(tmp_path: Path) -> None:
    assert table(tmp_path, f"phase_rad grey\n0 0\n{3 * np.pi / 4} 128\n{3 * np.pi / 2} 255\n", 4) == [0, 85, 170, 255]


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    for name in ("nowhere.csv", "binary"):
        with pytest.raises(InvalidInputError) as raised:
            LookupTable.from_file(tmp_path / name, 4)
        assert raised.value.subject == f"lookup table {tmp_path / name}"


def test_symbols_become_grey_values_of_their_own_table_alone() -> None:
    linear = LookupTable.linear(4)
    greys = linear.greys_of(np.array([[0, 3], [2, 1]]), 4)
    assert greys.dtype == np.uint8
    assert greys.tolist() == [[0, 192], [128, 64]]
    with pytest.raises(PageError, match="8 levels"):
        linear.greys_of(np.zeros((2, 2), np.uint8), 8)
    with pytest.raises(PageError, match="0 to 4"):
        linear.greys_of(np.array([[0, 4]]), 4)
    with pytest.raises(PageError, match="float64"):
        linear.greys_of(np.array([[0.5]]), 4)
