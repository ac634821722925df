"""Claims about the cameras: interference from polarisation states, counts from electrons, pixels from poses."""

import numpy as np
import pytest

from lightpage.device.state import Aberration, CameraPose, Drift, Sensor
from lightpage.simulator.cameras import (
    CameraView,
    expose,
    in_phase_intensity,
    quadrature_intensity,
    resample,
    to_counts,
)
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import perfect_device, small_profile


def complex_noise(seed: int, shape: tuple[int, ...] = (500,)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def wave_plate(axis_deg: float, retardation: float) -> np.ndarray:
    """Jones matrix in (p, s), time dependence exp(-i omega t): the slow component gains phase `retardation`."""
    turn = np.deg2rad(axis_deg)
    to_axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return to_axes.T @ np.diag([1, np.exp(1j * retardation)]) @ to_axes


def homodyne_ports(signal: np.ndarray, reference: np.ndarray, quarter_wave_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Intensities at the (s, p) ports behind wave plates, 50:50 beam splitter and polarising beam splitter.

    The signal comes s-polarised, the reference p-polarised; a half-wave plate shares the reference out evenly.
    """
    at_splitter = wave_plate(quarter_wave_deg, np.pi / 2) @ np.stack([0 * signal, signal])
    shared = wave_plate(22.5, np.pi) @ np.stack([reference, 0 * reference])
    p, s = (at_splitter + shared) / np.sqrt(2)
    return np.abs(s) ** 2, np.abs(p) ** 2


class TestInterference:
    @pytest.mark.parametrize(("quarter_wave_deg", "sign"), [(45.0, 1), (-45.0, -1)])
    def test_polarisation_states_give_the_two_intensities_up_to_a_constant_and_a_piston(
        self, quarter_wave_deg: float, sign: int
    ) -> None:
        field, reference = complex_noise(0), complex_noise(1)
        s, p = homodyne_ports(field, reference, quarter_wave_deg)
        # the quarter-wave plate also delays the signal as a whole by an eighth of a turn
        delayed = field * np.exp(0.25j * np.pi)
        np.testing.assert_allclose(s, in_phase_intensity(delayed, reference) / 4, rtol=1e-12)
        np.testing.assert_allclose(p, quadrature_intensity(delayed, reference, sign=sign) / 4, rtol=1e-12)

    @pytest.mark.parametrize("sign", [1, -1])
    def test_the_error_adds_to_the_angle_between_the_arms(self, sign: int) -> None:
        field, reference, error = complex_noise(4), complex_noise(5), np.deg2rad(7)
        turn = sign * np.pi / 2 + error
        expected = (field * reference.conj() * np.exp(-1j * turn)).real
        plain = np.abs(field) ** 2 + np.abs(reference) ** 2
        np.testing.assert_allclose(
            (quadrature_intensity(field, reference, error, sign) - plain) / 2, expected, atol=1e-12
        )

    def test_vibration_takes_contrast_as_the_mean_over_the_exposure_has_it(self) -> None:
        field, reference = complex_noise(6, (50, 1)), complex_noise(7, (50, 1))
        pistons, vibration = np.random.default_rng(8).standard_normal(200_000), Drift(vibration_rad=0.6)
        within = np.mean(in_phase_intensity(field * np.exp(0.6j * pistons), reference), axis=1)
        np.testing.assert_allclose(
            in_phase_intensity(field, reference, vibration.contrast)[:, 0], within, atol=0.01 * within.max()
        )


class TestExposure:
    def test_counts_without_light_are_the_black_level(self) -> None:
        sensor = Sensor(read_noise_e=0, black_level_relative=0.1)
        assert to_counts(np.array([0.0, 7500.0, 15_000.0]), sensor).tolist() == [26, 153, 255]

    def test_mean_and_variance_are_those_of_electrons_read_noise_and_rounding(self) -> None:
        sensor = Sensor(full_well_e=10_000, read_noise_e=30, bit_depth=8)
        electrons, pixels = 3000.0, 400_000
        counts = expose(np.full(pixels, 1.5), electrons / 1.5, sensor, np.random.default_rng(0)).astype(float)
        seen = counts * (10_000 / 255)
        variance = electrons + 30**2 + (10_000 / 255) ** 2 / 12
        assert seen.mean() == pytest.approx(electrons, abs=4 * np.sqrt(variance / pixels))
        assert seen.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / pixels))

    @pytest.mark.parametrize(("bit_depth", "top"), [(8, 255), (12, 4095), (16, 65_535)])
    def test_full_well_is_full_scale_and_nothing_leaves_the_range(self, bit_depth: int, top: int) -> None:
        sensor = Sensor(full_well_e=15_000, read_noise_e=0, bit_depth=bit_depth)
        counts = to_counts(np.array([-50.0, 0.0, 7500.0, 15_000.0, 1e9]), sensor)
        assert counts.tolist() == [0, 0, round(top / 2), top, top]
        bent = to_counts(np.linspace(0, 45_000, 50), sensor.model_copy(update={"nonlinearity_relative": -0.3}))
        assert np.all(np.diff(bent.astype(int)) >= 0)


class TestPose:
    @pytest.mark.parametrize("distortion", [0.0, 0.001, -0.003])
    def test_pixels_and_the_ray_twin_undo_each_other(self, distortion: float) -> None:
        profile = small_profile()
        poses = (
            CameraPose(scale_relative_error=0.01, rotation_deg=0.3, shift_x_px=12, shift_y_px=-9),
            CameraPose(scale_relative_error=-0.008, rotation_deg=-0.25, shift_x_px=-5.5, shift_y_px=11),
        )
        device = perfect_device(
            in_phase_camera=poses[0],
            quadrature_camera=poses[1],
            aberration=Aberration(distortion_relative=distortion, defocus_rad=0, astigmatism_rad=0, coma_rad=0),
        )
        twin, parameters = TorchTwin(RayTwin(profile)), true_parameters(profile, device)
        corner = profile.corner_m
        columns, rows = np.meshgrid(np.arange(profile.camera.columns_px), np.arange(profile.camera.rows_px))
        for camera, pose in enumerate(poses):
            edges = profile.page_width_m / 2, profile.page_height_m / 2
            x, y = CameraView(profile.camera, pose, distortion, corner, edges).positions_m()
            on_page = (np.abs(x) < profile.page_width_m / 2) & (np.abs(y) < profile.page_height_m / 2)
            pixels = twin.pixels(parameters, np.stack([x[on_page], y[on_page]], axis=-1))[camera]
            expected = np.stack([columns[on_page], rows[on_page]], axis=-1)
            # the simulator inverts the distortion to first order, so its square remains
            allowed = 1e-6 + 4 * distortion**2 * corner / profile.camera.pitch_m
            assert np.abs(pixels - expected).max() < allowed


class TestResample:
    def test_a_smooth_image_is_read_between_its_samples(self) -> None:
        x, y = np.linspace(-1e-3, 1e-3, 201), np.linspace(-0.5e-3, 0.5e-3, 101)

        def image(at_x: np.ndarray, at_y: np.ndarray) -> np.ndarray:
            return np.sin(2 * np.pi * at_x / 0.2e-3 + 1) * np.cos(2 * np.pi * at_y / 0.15e-3) + at_x / 1e-3

        rng = np.random.default_rng(0)
        at_x, at_y = rng.uniform(-0.8e-3, 0.8e-3, 300), rng.uniform(-0.4e-3, 0.4e-3, 300)
        got = resample(image(x[None, :], y[:, None]), x, y, at_x, at_y)
        assert np.abs(got - image(at_x, at_y)).max() < 1e-3
