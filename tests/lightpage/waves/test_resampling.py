"""Corrected linear interpolation passes a pipe's light alike at every place between two pixels."""

import numpy as np
import pytest

from lightpage.device.profile import load_profile
from lightpage.waves.grid import FieldGrid, field_grid
from lightpage.waves.resampling import interpolation_gain

PLACES = np.linspace(0, 0.95, 20)


@pytest.fixture(scope="module")
def grid() -> FieldGrid:
    return field_grid(load_profile("bench"))


def gain(taps: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    numbers = np.arange(len(taps)) - len(taps) // 2
    return np.asarray(np.cos(2 * np.pi * frequencies[:, None] * numbers) @ taps)


def errors(grid: FieldGrid, frequencies: np.ndarray, *, corrected: bool) -> np.ndarray:
    """Errors of the gain by place and frequency, [P, F]."""
    linear = np.stack([interpolation_gain(frequencies, place) for place in PLACES])
    if not corrected:
        return np.asarray(linear * gain(grid.prefilter, frequencies) - 1)
    prefilter, correction = grid.resampling
    share = (PLACES * (1 - PLACES))[:, None]
    corrections = 1 + share * gain(correction, grid.step_px * frequencies)
    return np.asarray(linear * corrections * gain(prefilter, frequencies) - 1)


def test_the_field_keeps_its_light_at_every_place(grid: FieldGrid) -> None:
    band = np.linspace(0, grid.edge, 30)
    assert np.abs(errors(grid, band, corrected=True)).max() < 0.005
    assert np.abs(errors(grid, band, corrected=False)).max() > 0.02


def test_the_power_of_the_field_keeps_most_of_it(grid: FieldGrid) -> None:
    band = np.linspace(0, 1.8 * grid.edge, 50)
    assert np.abs(errors(grid, band, corrected=True)).max() < 0.05
    assert np.abs(errors(grid, band, corrected=False)).max() > 0.1


def test_the_prefilter_keeps_noise_from_folding(grid: FieldGrid) -> None:
    stopped = np.linspace(0.4, 0.5, 20)
    assert np.abs(gain(grid.resampling.prefilter, stopped)).max() < 0.05
    assert grid.resampling.prefilter.sum() == pytest.approx(1)
