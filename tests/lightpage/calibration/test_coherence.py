"""Claims about coherence: high for light that the twin explains, next to none for other light, less when misled."""

import numpy as np
import pytest

from lightpage.calibration.coherence import branch_shares, page_coherence, seen_share
from lightpage.calibration.interfaces import BRANCHES
from lightpage.calibration.parameters import NAMES, nominal
from lightpage.calibration.samplers import FieldSampler
from lightpage.device.state import Geometry
from lightpage.simulator.simulator import resample
from lightpage.simulator.true_optics import TrueOptics, true_parameters
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.waves.grid import field_grid
from tests.lightpage.calibration.flat_twin import FlatTwin, Picture
from tests.lightpage.small import on_slm, perfect_device, random_phases, small_profile

PROFILE = small_profile()
PHASES = random_phases(PROFILE, 1)
SYMBOLS = np.exp(1j * PHASES)
DEVICE = perfect_device(
    geometry=Geometry(pipe_angle_deg=-0.6, page_shift_x_px=2, page_shift_y_px=-1, pipe_roll_deg=0.1)
)
TWIN = TorchTwin(RayTwin(PROFILE))
TRUTH = true_parameters(PROFILE, DEVICE)


@pytest.fixture(scope="module")
def light() -> FieldSampler:
    """The true field of a page in a sheared pipe, without noise."""
    optics, grid = TrueOptics(PROFILE, DEVICE, steps=16), field_grid(PROFILE)
    field = optics.camera_field(optics.exit_field(on_slm(PHASES, PROFILE)))
    x, y = np.meshgrid(grid.x_m, grid.y_m)
    real, imaginary = (resample(part, *optics.camera_axes_m, x, y) for part in (field.real, field.imag))
    return FieldSampler((real + 1j * imaginary).astype(np.complex64), grid)


def test_light_that_a_twin_explains_has_the_coherence_of_its_share() -> None:
    """All branches of this twin see the same light, and only the first of the three has any weight."""
    seen = page_coherence(Picture(PROFILE, SYMBOLS), FlatTwin(PROFILE), nominal(), PROFILE, SYMBOLS)
    assert seen == pytest.approx(1 / np.sqrt(3), rel=0.05)


def test_unrelated_symbols_have_next_to_none(light: FieldSampler) -> None:
    for seed in (5, 6, 7):
        other = np.exp(1j * random_phases(PROFILE, seed))
        assert page_coherence(light, TWIN, TRUTH, PROFILE, other) < 4 / np.sqrt(PHASES.size)


def test_the_true_geometry_explains_waves_and_every_deviation_less(light: FieldSampler) -> None:
    best = page_coherence(light, TWIN, TRUTH, PROFILE, SYMBOLS)
    assert best > 0.45
    for name, step in (
        ("pipe_angle_rad", np.deg2rad(0.5)),
        ("page_centre_x_m", 12e-6),
        ("pipe_length_relative", 0.008),
        ("launch_defocus_rad", 2.0),
        ("camera_tilt_y_rad", 1.0),
    ):
        for sign in (1, -1):
            wrong = TRUTH.copy()
            wrong[NAMES.index(name)] += sign * step
            assert page_coherence(light, TWIN, wrong, PROFILE, SYMBOLS) < best - 0.01, name


def test_the_branches_share_all_of_the_light() -> None:
    positions = np.random.default_rng(0).uniform(-3, 3, (200, 2))
    np.testing.assert_allclose(branch_shares(positions, BRANCHES).sum(axis=0), 1)


def test_light_that_misses_a_camera_is_not_counted_as_seen() -> None:
    assert seen_share(TWIN, TRUTH, PROFILE).min() > 0.8
    away = TRUTH.copy()
    away[NAMES.index("quadrature_shift_x_px")] += PROFILE.camera.columns_px / 2
    seen = seen_share(TWIN, away, PROFILE)
    assert np.mean(seen < 0.5) == pytest.approx(0.5, abs=0.02)  # the page lies in the middle of the camera
    assert seen.min() < 0.1
    assert seen.max() > 0.9
