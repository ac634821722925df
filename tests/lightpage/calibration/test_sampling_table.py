"""Claims about the sampling table: rebuilt from it, every sample of every symbol lies where the twin would trace it."""

import numpy as np
import pytest

from lightpage.calibration.interfaces import BRANCHES
from lightpage.calibration.parameters import NAMES, PRIORS, indices
from lightpage.calibration.sampling_table import (
    monomial_powers,
    moved_cameras,
    registration_coefficients,
    sampling_table,
    shifted,
    symbol_centres,
)
from lightpage.device.profile import Profile, load_profile
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.waves.grid import field_grid
from tests.lightpage.small import small_profile

TURN = -1.5


def some_device() -> np.ndarray:
    """Draw parameters off nominal, with the shear and distortion of a device at the edge of its range."""
    vector = 0.5 * PRIORS * np.random.default_rng(0).standard_normal(len(PRIORS))
    vector[NAMES.index("pipe_angle_rad")] = -0.015
    vector[NAMES.index("distortion_relative")] = 0.003
    return vector


@pytest.mark.parametrize("right", [True, False])
@pytest.mark.parametrize("profile", [small_profile(), load_profile("bench")], ids=lambda p: p.name)
def test_four_by_four_samples_rebuilt_from_it_are_those_that_the_twin_traces(profile: Profile, right: bool) -> None:
    twin, parameters, grid = TorchTwin(RayTwin(profile)), some_device(), field_grid(profile)
    # a plane off its focal plane moves a landing place by where its branch's light crosses the facet, and the middle of
    # that light is not linear over a symbol; axial places of some 0.1 rad and tilts of 0.07 leave 1e-2
    off = 1e-3 if right else 1e-2
    parameters[indices("tilt")] /= 2
    if right:
        parameters[indices("axial", "tilt")] = 0
    table = sampling_table(twin, parameters, TURN, profile)
    centres = symbol_centres(profile)
    shape = (len(BRANCHES), *profile.page_shape)
    for dx in (-0.375, -0.125, 0.125, 0.375):
        for dy in (-0.375, 0.125):
            rays = twin.trace(parameters, centres + np.array([dx, dy]) * profile.symbol_pitch_m, centres)
            place, slope = table["places"].astype(float), table["place_gradients"].astype(float)
            column = place[:, 0] + slope[:, 0] * dx + slope[:, 1] * dy
            row = place[:, 1] + slope[:, 2] * dx + slope[:, 3] * dy
            expected = (rays.places - [grid.x_m[0], grid.y_m[0]]) / grid.pitch_m
            np.testing.assert_allclose(column, expected[..., 0].reshape(shape), rtol=0, atol=off)
            np.testing.assert_allclose(row, expected[..., 1].reshape(shape), rtol=0, atol=off)
            p = np.moveaxis(table["phases"].astype(float), 1, 0)
            phase = p[0] + p[1] * dx + p[2] * dy + p[3] * dx**2 / 2 + p[4] * dx * dy + p[5] * dy**2 / 2
            turned = np.angle(np.exp(1j * (phase - rays.phases.reshape(shape))))
            assert np.abs(turned).max() < 2e-3


def test_its_maps_have_the_names_and_shapes_that_a_decoder_takes_and_no_digits_that_nobody_needs() -> None:
    profile = small_profile()
    twin, parameters = TorchTwin(RayTwin(profile)), some_device()
    table = sampling_table(twin, parameters, TURN, profile)
    branches, page = len(BRANCHES), profile.page_shape
    assert {name: array.shape for name, array in table.items()} == {
        "registration": (2, 2, 10),
        "homodyne": (2,),
        "apart": (2, 25),
        "apart_beside": (2, 2, 25),
        "apart_tilt": (2,),
        "parameters": (len(NAMES),),
        "places": (branches, 2, *page),
        "place_gradients": (branches, 4, *page),
        "phases": (branches, 6, *page),
        "positions": (2, *page),
    }
    assert {array.dtype for array in table.values()} == {np.dtype(np.float32)}
    np.testing.assert_allclose(table["homodyne"], [np.cos(TURN), np.sin(TURN)], rtol=1e-6)
    assert np.abs(table["phases"][:, 0]).max() <= np.pi + 1e-6
    positions = twin.trace(parameters, symbol_centres(profile)).positions
    np.testing.assert_allclose(table["positions"].reshape(2, -1).T, positions, atol=1e-6)
    for name, bits in (("places", 14), ("place_gradients", 14), ("phases", 16)):
        scaled = table[name].astype(np.float64) * 2.0**bits
        np.testing.assert_array_equal(scaled, np.rint(scaled), err_msg=name)


def test_a_cubic_holds_the_pixels_of_the_whole_grid() -> None:
    profile = small_profile()
    twin, parameters, grid = TorchTwin(RayTwin(profile)), some_device(), field_grid(profile)
    coefficients = registration_coefficients(twin, parameters, profile).astype(float)
    rng = np.random.default_rng(1)
    places = np.stack([rng.choice(grid.x_m, 500), rng.choice(grid.y_m, 500)], axis=-1)
    u, v = places.T / (np.hypot(profile.page_width_m, profile.page_height_m) / 2)
    terms = np.stack([u**i * v**j for i, j in monomial_powers()])
    rebuilt = np.moveaxis(coefficients @ terms, 1, -1)
    assert np.abs(rebuilt - twin.pixels(parameters, places)).max() < 1e-3


def test_an_image_that_moves_moves_the_other_way_on_a_camera_that_is_turned() -> None:
    profile, parameters, shift = small_profile(), some_device(), np.array([1.5, -0.5])
    parameters[indices("quadrature")] += [0, 0, -2, -2, 0, 0]
    twin = TorchTwin(RayTwin(profile))
    before = registration_coefficients(twin, parameters, profile)
    after = registration_coefficients(twin, moved_cameras(parameters, shift), profile)
    np.testing.assert_allclose(shifted(before, shift), after, atol=1e-3)
    np.testing.assert_allclose((after - before)[..., 0], [shift, -shift], atol=1e-3)
