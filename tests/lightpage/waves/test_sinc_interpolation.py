"""Claims about sparse samples: between them light of a band is known, to its edge, on any axis that is finer."""

from __future__ import annotations

import numpy as np
import pytest

from lightpage.waves.sinc_interpolation import interpolation, sparse_axis

HIGHEST = 42e3
"""Cycles a metre."""
PITCH = 1 / (6 * HIGHEST)
PLACES = 3e-4 + PITCH * np.arange(300)
WORST = 1e-4
"""That the module promises for the edge of the band."""


def waves(places: np.ndarray) -> np.ndarray:
    """Plane waves of the whole band at places, as large as samples are."""
    along = np.outer(places, np.linspace(-HIGHEST, HIGHEST, 101))
    return np.asarray(np.exp(2j * np.pi * along) * np.sqrt(places[1] - places[0]))


@pytest.mark.parametrize("finer", [1, 2, 7])
def test_light_of_the_band_is_interpolated_everywhere_on_the_axis(finer: int) -> None:
    places = np.linspace(PLACES[0], PLACES[-1], finer * len(PLACES))
    sparse = sparse_axis(places, HIGHEST)
    assert len(sparse) < 0.6 * len(places) / finer
    expected = waves(places)
    error = np.abs(interpolation(places, sparse) @ waves(sparse) - expected) / np.abs(expected)
    assert error.max() < WORST


def test_few_samples_serve_where_less_will_do() -> None:
    sparse = sparse_axis(PLACES, HIGHEST, 1.1)
    assert len(sparse) < len(sparse_axis(PLACES, HIGHEST))
    error = interpolation(PLACES, sparse, 1.1) @ waves(sparse) - waves(PLACES)
    assert np.linalg.norm(error) < 0.003 * np.linalg.norm(waves(PLACES))


def test_samples_are_uniform_and_reach_beyond_both_ends() -> None:
    sparse = sparse_axis(PLACES, HIGHEST)
    assert sparse[0] < PLACES[0] < PLACES[-1] < sparse[-1]
    np.testing.assert_allclose(np.diff(sparse), sparse[1] - sparse[0])


@pytest.mark.parametrize("step", [2, 3])
def test_an_axis_with_no_more_places_than_samples_stays_as_it_is(step: int) -> None:
    places = PLACES[::step]
    assert sparse_axis(places, HIGHEST) is places
    np.testing.assert_allclose(interpolation(places, places), np.eye(len(places)), atol=1e-12)
