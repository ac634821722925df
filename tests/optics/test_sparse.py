"""Claims about sparse samples: between them the pipe's light is known, to its edge, on any axis that is finer."""

from __future__ import annotations

import numpy as np
import pytest

from optics.grid import field_grid
from optics.profile import Profile, load_profile
from optics.sparse import interpolation, sparse_axis
from tests.optics.small import small_profile

PROFILES = [small_profile(), load_profile("bench"), load_profile("paper")]


@pytest.fixture(params=PROFILES, ids=lambda p: p.name)
def profile(request: pytest.FixtureRequest) -> Profile:
    assert isinstance(request.param, Profile)
    return request.param


def waves(profile: Profile, places: np.ndarray) -> np.ndarray:
    """Plane waves of the pipe's band, edges and a little of misalignment included, at places; as large as samples."""
    edge = 1.02 * profile.pipe.width_m / 2 / (profile.light.wavelength_m * profile.lens.focal_length_m)
    along = np.outer(places, np.linspace(-edge, edge, 101))
    return np.asarray(np.exp(2j * np.pi * along) * np.sqrt(places[1] - places[0]))


@pytest.mark.parametrize("finer", [1, 3])
def test_light_of_the_band_is_interpolated_everywhere_on_the_axis(profile: Profile, finer: int) -> None:
    places = field_grid(profile).x_m
    places = np.linspace(places[0], places[-1], finer * len(places))
    sparse = sparse_axis(profile, places)
    expected = waves(profile, places)
    error = np.abs(interpolation(places, sparse) @ waves(profile, sparse) - expected) / np.abs(expected)
    assert error.max() < 3e-4


def test_a_fine_axis_has_fewer_samples_than_places_and_all_of_it_between_them(profile: Profile) -> None:
    places = field_grid(profile).y_m
    sparse = sparse_axis(profile, places)
    assert sparse[1] - sparse[0] > 1.8 * (places[1] - places[0])
    assert sparse[0] < places[0] < places[-1] < sparse[-1]
    np.testing.assert_allclose(np.diff(sparse), sparse[1] - sparse[0])


def test_an_axis_that_is_as_sparse_stays_as_it_is(profile: Profile) -> None:
    places = field_grid(profile).x_m[::4]
    assert sparse_axis(profile, places) is places
    np.testing.assert_allclose(interpolation(places, places), np.eye(len(places)), atol=1e-12)
