"""The page: pilots cover it evenly and repeat with the seed; symbols out of range are refused by name."""

import numpy as np
import pytest

from lightpage.device.profile import load_profile
from lightpage.errors import PageError
from lightpage.page.symbols import check_levels, check_symbols, pilot_mask, pilot_symbols, random_symbols, symbol_phases
from tests.lightpage.refused import refused


def test_one_pilot_pattern_serves_every_level_count() -> None:
    """floor(u M) of the same u: the pattern of 4 levels is the coarse reading of that of 256."""
    profile = load_profile("bench")
    assert np.array_equal(pilot_symbols(profile, 4), pilot_symbols(profile, 256) // 64)


@pytest.mark.parametrize("levels", [2, 3, 16, 256])
def test_random_symbols_use_every_level_and_carry_the_pilots(levels: int) -> None:
    profile = load_profile("bench")
    symbols = random_symbols(profile, levels, 2, np.random.default_rng(5))
    mask = pilot_mask(profile)
    assert symbols.dtype == np.uint8
    assert set(np.unique(symbols)) == set(range(levels))
    for page in symbols:
        assert np.array_equal(page[mask], pilot_symbols(profile, levels)[mask])
    data = symbols[:, ~mask]
    assert not np.array_equal(data[0], data[1])
    counts = np.bincount(data.ravel(), minlength=levels)
    assert abs(counts - data.size / levels).max() < 6 * np.sqrt(data.size / levels)


def test_phase_is_the_level_share_of_a_turn() -> None:
    assert symbol_phases(np.array([0, 1, 2, 3], dtype=np.uint8), 4) == pytest.approx([0, np.pi / 2, np.pi, 1.5 * np.pi])
    assert symbol_phases(np.array([255], dtype=np.uint8), 256)[0] == pytest.approx(2 * np.pi * 255 / 256)


@pytest.mark.parametrize("levels", [1, 0, 257, 2.5, True, "16"])
def test_level_counts_outside_2_to_256_are_refused(levels: object) -> None:
    with refused("levels", levels, PageError):
        check_levels(levels)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("symbols", "got"),
    [
        (np.zeros((4, 6), np.float64), "float64"),
        (np.zeros((6, 4), np.uint8), (6, 4)),
        (np.zeros(24, np.uint8), (24,)),
        (np.full((4, 6), 16, np.uint8), 16),
        (np.full((2, 4, 6), -1, np.int64), -1),
        (np.zeros((4, 6), np.bool_), "bool"),
    ],
)
def test_wrong_symbols_are_refused_with_what_came(symbols: np.ndarray, got: object) -> None:
    with refused("uploaded page", got, PageError):
        check_symbols(symbols, (4, 6), 16, "uploaded page")


def test_good_symbols_come_back_as_bytes() -> None:
    checked = check_symbols(np.arange(72).reshape(3, 4, 6) % 16, (4, 6), 16, "page")
    assert checked.dtype == np.uint8
    assert checked.shape == (3, 4, 6)
    assert np.array_equal(checked.ravel(), np.arange(72) % 16)


def test_a_negative_page_count_is_refused() -> None:
    with refused(got=-1, kind=PageError):
        random_symbols(load_profile("bench"), 16, -1, np.random.default_rng(0))
