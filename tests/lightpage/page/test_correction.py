"""A smooth phase error is taken off without knowing the data, and nothing where there is nothing to know it by."""

import numpy as np
import pytest

from lightpage.page.correction import ROUNDS, PhaseRefit
from lightpage.page.levels import Levels
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import symbol_phases
from tests.lightpage.uneven import overlapping, uneven

SHAPE = (48, 80)
Y, X = np.meshgrid(np.linspace(-1, 1, SHAPE[0]), np.linspace(-1, 1, SHAPE[1]), indexing="ij")
POSITIONS = np.stack([1.4 * X, 1.4 * Y])
"""Light of the page's middle meets no wall; that of its edges one, or two in the corners: four zones."""
ZONES = (np.abs(POSITIONS[0]) > 0.5) + 2 * (np.abs(POSITIONS[1]) > 0.5)
COEFFICIENTS = 12
"""A plane in each zone."""


def smooth(levels: int, size: float = 0.25) -> np.ndarray:
    """A plane over the page and a step from zone to zone; at most `size` of the distance between levels."""
    error = 0.4 * X - 0.3 * Y + np.array([-0.3, 0.1, 0.3, -0.2])[ZONES]
    return size * 2 * np.pi / levels * error / np.abs(error).max()


def page(
    levels: int | Levels, kappa: np.ndarray | float, error: np.ndarray, pilots: float = 0.02, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, Pilots]:
    """Phases and concentrations of random symbols in noise, with an error, and their pilots."""
    rng = np.random.default_rng(seed)
    symbols = rng.integers(0, Levels.of(levels).count, error.shape, np.uint8)
    concentration = np.broadcast_to(kappa, error.shape).astype(float)
    phase = symbol_phases(symbols, levels) + error + rng.vonmises(0, np.maximum(concentration, 1e-3))
    mask = rng.random(error.shape) < pilots
    mask[0, 0] = True
    wrapped = np.angle(np.exp(1j * phase)).astype(np.float32)
    return wrapped, concentration.astype(np.float32), Pilots.of_symbols(mask, symbols, levels)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def noise_of_fit(kappa: float, symbols: int) -> float:
    """Error that as many coefficients as there are have from the noise of so many symbols, all of them known."""
    return float(np.sqrt(COEFFICIENTS / (kappa * symbols)))


def test_a_plane_and_a_step_between_zones_are_found_without_the_data() -> None:
    kappa, error = 2000.0, smooth(64)
    assert rms(error) > 8 * noise_of_fit(kappa, error.size)
    for seed in range(3):
        phase, concentration, pilots = page(64, kappa, error, pilots=0.0, seed=seed)
        assert len(pilots.phases) == 1
        found = PhaseRefit(SHAPE, POSITIONS).error(phase, concentration, 64, pilots)
        # not knowing the levels costs some of what the noise allows, more where the error is a quarter of a level
        assert rms(found - error) < 2 * noise_of_fit(kappa, error.size)


def test_where_zones_are_unknown_the_page_is_one() -> None:
    phase, concentration, pilots = page(64, 2000.0, smooth(64))
    found = PhaseRefit(SHAPE).error(phase, concentration, 64, pilots)
    plane = np.stack([np.ones(X.size), X.ravel(), Y.ravel()])
    left = found.ravel() - np.linalg.lstsq(plane.T, found.ravel().astype(float), rcond=None)[0] @ plane
    assert np.abs(left).max() < 1e-6  # a single plane, whatever the steps
    assert rms(found - smooth(64)) > 3 * noise_of_fit(2000.0, X.size)


@pytest.mark.parametrize("shown", [2, 3, 256, uneven(3), uneven(64), overlapping(16)])
def test_it_works_at_any_number_of_levels(shown: int | Levels) -> None:
    levels = Levels.of(shown).count
    # at least four and a half deviations from level to level, as 64 levels have at a concentration of 2000
    kappa = max(2000.0, (4.4 * levels / (2 * np.pi)) ** 2)
    error = min(1.0, levels / 32) * smooth(levels)  # 0.05 rad, about what is expected beforehand, where levels are few
    phase, concentration, pilots = page(shown, kappa, error)
    found = PhaseRefit(SHAPE, POSITIONS).error(phase, concentration, shown, pilots)
    assert rms(found - error) < 2 * noise_of_fit(kappa, error.size)


@pytest.mark.parametrize(("levels", "kappa"), [(64, 0.0), (64, 50.0), (256, 100.0), (3, 0.02)])
def test_nothing_is_taken_off_where_levels_cannot_be_told_apart(levels: int, kappa: float) -> None:
    """Noise of about two levels and more, and a single pilot."""
    error, step = smooth(levels), 2 * np.pi / levels
    # Distances to the nearest level are uniform then. Each round may take their mean for an error anew.
    chance = ROUNDS * step / np.sqrt(12) * np.sqrt(COEFFICIENTS / error.size)
    for seed in range(5):
        phase, concentration, pilots = page(levels, kappa, error, pilots=0.0, seed=seed)
        found = PhaseRefit(SHAPE, POSITIONS).error(phase, concentration, levels, pilots)
        assert rms(found) < chance < rms(error)


@pytest.mark.parametrize("levels", [2, 256])
def test_pilots_alone_suffice_where_no_other_symbol_has_weight(levels: int) -> None:
    """Then the error may exceed the distance between levels by far."""
    kappa, rng = 2000.0, np.random.default_rng(1)
    error = smooth(2, 0.1)  # up to 0.3 rad
    lit = rng.random(SHAPE) < 0.1
    symbols = rng.integers(0, levels, SHAPE, np.uint8)
    phase = np.where(lit, symbol_phases(symbols, levels) + error + rng.vonmises(0, kappa, SHAPE), rng.uniform(-3, 3))
    pilots = Pilots.of_symbols(lit, symbols, levels)
    found = PhaseRefit(SHAPE, POSITIONS).error(phase, np.where(lit, kappa, 0), levels, pilots)
    assert rms(error) > 0.1
    assert rms(found - error) < 2 * noise_of_fit(kappa, int(lit.sum()))


def test_a_page_of_more_symbols_than_are_taken() -> None:
    shape = (160, 200)
    y, x = np.meshgrid(np.linspace(-1, 1, 160), np.linspace(-1, 1, 200), indexing="ij")
    error = 0.02 * x - 0.01 * y
    phase, concentration, pilots = page(64, 2000.0, error)
    found = PhaseRefit(shape).error(phase, concentration, 64, pilots)
    assert found.shape == shape
    assert rms(found - error) < 2 * noise_of_fit(2000.0, 16_000)
