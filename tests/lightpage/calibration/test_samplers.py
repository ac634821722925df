"""Samplers show the field, one camera's its projection; a shift over a reference that stays adds to its phase."""

import numpy as np
import pytest

from lightpage.calibration.phases import camera_phase, tilt_of_shift
from lightpage.calibration.samplers import FieldSampler, FrameSampler
from lightpage.device.state import CameraPose, Homodyne, Reference, Sensor
from lightpage.simulator.simulator import Simulator, resample
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.waves.grid import field_grid
from tests.lightpage.small import perfect_device, small_profile

PROFILE = small_profile()
TWIN = TorchTwin(RayTwin(PROFILE))


class TestFieldSampler:
    def test_between_samples_it_follows_a_wave_of_the_pipes_band(self) -> None:
        grid = field_grid(PROFILE)
        edge = PROFILE.pipe.width_m / 2 / (PROFILE.light.wavelength_m * PROFILE.lens.focal_length_m)
        k = 2 * np.pi * 0.9 * edge * np.array([0.8, -0.6])

        def wave(places: np.ndarray) -> np.ndarray:
            return np.exp(1j * places @ k)

        x, y = np.meshgrid(grid.x_m, grid.y_m)
        sampler = FieldSampler(wave(np.stack([x, y], axis=-1)).astype(np.complex64), grid)
        places = np.random.default_rng(1).uniform(-0.4e-3, 0.4e-3, (3, 70, 2))
        got = sampler(places)
        assert got.shape == (3, 70)
        assert np.abs(got - wave(places)).max() < 0.02


class TestFrameSampler:
    @pytest.mark.parametrize("camera", [0, 1])
    def test_a_frame_shows_the_field_against_its_reference_where_the_twin_says(self, camera: int) -> None:
        device = perfect_device(
            in_phase_camera=CameraPose(scale_relative_error=0.01, rotation_deg=0.3, shift_x_px=5, shift_y_px=-8),
            quadrature_camera=CameraPose(scale_relative_error=-0.01, rotation_deg=-0.2, shift_x_px=-9, shift_y_px=3),
            reference=Reference(amplitude_ratio=4, ripple_relative=0.05, tilt_x_rad=2, tilt_y_rad=-1, curvature_rad=1),
            homodyne=Homodyne(quadrature_error_deg=0, quadrature_gain=0.9, quadrature_sign=-1),
            sensor=Sensor(full_well_e=1e9, read_noise_e=0, bit_depth=16),
        )
        simulator = Simulator(PROFILE, device, seed=1, steps=1)
        symbols = np.random.default_rng(0).integers(256, size=PROFILE.page_shape).astype(np.uint8)
        page, references, optics = simulator.simulate(symbols), simulator.references(), simulator.optics
        frame, reference = ((page.pair.in_phase, references.in_phase), (page.pair.quadrature, references.quadrature))[
            camera
        ]
        sampler = FrameSampler(frame, reference, camera, TWIN, true_parameters(PROFILE, device))
        half = 0.9 * np.array([PROFILE.page_width_m, PROFILE.page_height_m]) / 2
        places = np.random.default_rng(2).uniform(-half, half, (2000, 2))
        beam = optics.reference()
        against = optics.camera_field(page.exit_field) * np.exp(1j * (page.piston - np.angle(beam)))
        # Q is mounted the other way round, so it shows minus the imaginary part
        part = against.real if camera == 0 else -against.imag
        expected = resample(part, *optics.camera_axes_m, *places.T)
        seen = sampler(places)
        assert np.corrcoef(seen, expected)[0, 1] > 0.9
        other = resample(against.imag if camera == 0 else against.real, *optics.camera_axes_m, *places.T)
        assert abs(np.corrcoef(seen, other)[0, 1]) < 0.1

    def test_a_dark_reference_gives_no_nan(self) -> None:
        dark = np.zeros(PROFILE.frame_shape, np.uint8)
        sampler = FrameSampler(dark + 3, dark, 1, TWIN, true_parameters(PROFILE, perfect_device()))
        assert np.isfinite(sampler(np.zeros((4, 2)))).all()


CAMERA_TERMS = ("tilt_x", "tilt_y", "curvature", "astigmatism_0", "astigmatism_45")
HALF_WIDTH, HALF_HEIGHT = 1.6e-3, 1.0e-3
CORNER = float(np.hypot(HALF_WIDTH, HALF_HEIGHT))


def phase_of(value: dict[str, float], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the camera phase at points in metres, radians."""
    return np.asarray(camera_phase(value, x / CORNER, y / CORNER, HALF_WIDTH / CORNER, HALF_HEIGHT / CORNER))


@pytest.mark.parametrize("seed", range(3))
def test_a_shift_over_a_curved_reference_is_a_tilt_and_a_piston(seed: int) -> None:
    rng = np.random.default_rng(seed)
    value = {f"camera_{name}_rad": float(rng.normal()) for name in CAMERA_TERMS}
    shift = rng.uniform(-3e-5, 3e-5, 2)
    x, y = rng.uniform(-1, 1, (2, 50)) * [[HALF_WIDTH], [HALF_HEIGHT]]
    gained = phase_of(value, x + shift[0], y + shift[1]) - phase_of(value, x, y)
    tilt = tilt_of_shift(value, shift, HALF_WIDTH, HALF_HEIGHT)
    left = gained - tilt[0] * x / HALF_WIDTH - tilt[1] * y / HALF_HEIGHT
    np.testing.assert_allclose(left, left[0], atol=1e-12)
