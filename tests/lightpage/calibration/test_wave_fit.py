"""Claims about the fit to waves: a known page places both cameras and tells the device, with calibrated deviations."""

import numpy as np
import pytest

from lightpage.calibration.parameters import GROUPS, NAMES, PRIORS, indices
from lightpage.calibration.waves import wave_fit
from lightpage.calibration.waves.wave_fit import LevelPrior, WaveFit
from lightpage.device.profile import Profile
from lightpage.device.state import (
    Aberration,
    CameraPose,
    Device,
    Drift,
    Geometry,
    Homodyne,
    Reference,
    Sensor,
    SlmDefects,
    draw_device,
)
from lightpage.page.modulation import DRIFTS, NOMINAL
from lightpage.page.symbols import symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_modulation, true_parameters
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.waves.grid import field_grid
from tests.lightpage.small import THICK, small_profile

PROFILE = small_profile()
TWIN = TorchTwin(RayTwin(PROFILE))
TURN = np.deg2rad(-90 + 3)


def seen_by(device: Device, seed: int, profile: Profile = PROFILE, *, turned: bool = False) -> WaveFit:
    """The fit of one random page of a device, whose quadrature camera may be turned by 180 degrees."""
    simulator = Simulator(profile, device, seed=seed)
    symbols = np.random.default_rng(seed).integers(256, size=profile.page_shape).astype(np.uint8)
    pair, references = simulator.page(symbols), simulator.references()
    if turned:
        pair, references = (FramePair(each.in_phase, np.flip(each.quadrature)) for each in (pair, references))
    twin = TWIN if profile is PROFILE else TorchTwin(RayTwin(profile))
    return WaveFit(twin, profile, pair, references, np.exp(1j * symbol_phases(symbols, 256)))


@pytest.mark.parametrize("turned", [False, True])
def test_both_cameras_and_the_angle_between_the_arms_come_back_in_dim_light(turned: bool) -> None:
    device = Device(
        in_phase_camera=CameraPose(scale_relative_error=2e-3, rotation_deg=0.1, shift_x_px=1.0),
        quadrature_camera=CameraPose(scale_relative_error=-1e-3, rotation_deg=-0.1, shift_y_px=-2.0),
        aberration=Aberration(distortion_relative=0),
        reference=Reference(amplitude_ratio=1.6),
        homodyne=Homodyne(quadrature_error_deg=3, quadrature_sign=-1, quadrature_gain=0.9),
        sensor=Sensor(full_well_e=100.0),
        drift=Drift(shift_px=0),
    )
    truth, centre = true_parameters(PROFILE, device), np.zeros(len(PRIORS))
    if turned:
        centre[indices("quadrature")] = [0, 0, -2, -2, 0, 0]
        truth = np.where(np.isin(np.arange(len(PRIORS)), indices("quadrature")), centre - truth, truth)
    start = truth.copy()
    start[indices("in_phase")] += [0.3, 0.1, 1e-3, 0, 1e-3, 0]
    start[indices("quadrature")] += [-0.4, 0.2, -1e-3, 1e-3, 0, 2e-3]
    result = seen_by(device, 1, turned=turned).fit(start, TURN + np.deg2rad(8), ("in_phase", "quadrature"), centre)
    found, turn = result.parameters, result.quadrature_phase

    grid = field_grid(PROFILE)
    places = np.stack(np.meshgrid(grid.x_m, grid.y_m), axis=-1).reshape(-1, 2)
    places = places[np.all(np.abs(places) < [PROFILE.page_width_m / 2, PROFILE.page_height_m / 2], axis=1)]

    def off(parameters: np.ndarray) -> np.ndarray:
        """Largest error of either camera's place, pixels."""
        errors = TWIN.pixels(parameters, places) - TWIN.pixels(truth, places)
        return np.asarray(np.linalg.norm(errors, axis=-1).max(axis=1))

    assert np.all(off(start) > 0.4)
    assert np.all(off(found) < 0.1)
    assert abs(np.rad2deg(turn - TURN)) < 0.3
    poses = np.r_[indices("in_phase"), indices("quadrature")]
    assert np.array_equal(np.delete(found, poses), np.delete(truth, poses))
    assert np.array_equal(np.flatnonzero(result.deviations), np.sort(poses))


def test_a_realistic_device_is_told_from_near_it_with_calibrated_deviations() -> None:
    seed = 1  # a taper is told by the other parameters
    device = draw_device(np.random.default_rng(seed)).with_settings(["geometry.pipe_taper_relative=0.003"])
    truth, levels = true_parameters(PROFILE, device), true_modulation(device.slm, PROFILE)
    rng, (angle, lenses) = np.random.default_rng([seed, 1]), map(NAMES.index, ("pipe_angle_rad", "lens_path_relative"))
    start = truth + 0.02 * PRIORS * rng.standard_normal(len(PRIORS))
    start[angle] = truth[angle] + 4e-4
    fit = seen_by(device, seed)
    found = fit.fit(start, device.homodyne.turn_rad, GROUPS, modulation=levels)
    again = fit.fit(found.parameters, found.quadrature_phase, GROUPS, modulation=levels).parameters
    assert np.mean(((again - found.parameters) / np.maximum(found.deviations, 1e-30)) ** 2) < 0.25**2
    assert abs(found.parameters[angle] - truth[angle]) < 3 * found.deviations[angle] < 3e-4
    off_rad = abs(found.quadrature_phase - device.homodyne.turn_rad)
    assert off_rad < min(np.deg2rad(0.3), 3 * (found.quadrature_deviation or 0)) < 0.02
    moving = indices("in_phase", "quadrature")[::6], indices("in_phase", "quadrature")[1::6]
    assert found.deviations[lenses] == 0  # these are ideal, and it does nothing
    known = [i for i in range(len(PRIORS)) if i not in (*np.ravel(moving), lenses)]  # the image has moved since
    off = (found.parameters - truth)[known] / found.deviations[known]
    assert np.sqrt(np.mean(off**2)) < 2


def test_a_fit_tells_of_every_round() -> None:
    device, shares = Device(drift=Drift(shift_px=0)), list[float]()
    start = true_parameters(PROFILE, device)
    seen_by(device, 1).fit(start, device.homodyne.turn_rad, ("in_phase", "angle"), progress=shares.append)
    assert shares == sorted(shares)
    assert {0, 1 / wave_fit.ROUNDS} <= set(shares) <= {n / wave_fit.ROUNDS for n in range(wave_fit.ROUNDS)}


def test_how_much_path_real_lenses_add_comes_back() -> None:
    index = NAMES.index("lens_path_relative")
    thick = PROFILE.model_copy(update={"lens_path": THICK.times(0.25)})  # a quarter as much takes a tenth of the time
    device = Device(aberration=Aberration(lens_path_relative_error=0.1))
    truth = true_parameters(thick, device)
    start = truth.copy()
    start[index] = 0
    found = seen_by(device, 4, thick).fit(start, device.homodyne.turn_rad, GROUPS)
    assert 0 < found.deviations[index] < 0.02
    assert found.parameters[index] == pytest.approx(0.1, abs=3 * found.deviations[index])


def test_held_parameters_keep_their_values_and_priors_hold_the_others() -> None:
    device = draw_device(np.random.default_rng(3))
    truth, levels = true_parameters(PROFILE, device), true_modulation(device.slm, PROFILE)
    fit, start = seen_by(device, 3), truth.copy()
    angle = NAMES.index("pipe_angle_rad")
    start[angle] += 4e-4
    free = fit.fit(start, device.homodyne.turn_rad, ("angle",), modulation=levels)
    held = fit.fit(start, device.homodyne.turn_rad, ("angle",), centre=start, prior_scale=1e-4, modulation=levels)
    assert np.array_equal(np.flatnonzero(free.parameters - start), [angle])
    assert abs(free.parameters[angle] - truth[angle]) < 1e-4
    assert abs(held.parameters[angle] - start[angle]) < 1e-5
    assert free.residual < held.residual


def test_a_nominal_modulator_stays_nominal_and_axial_places_and_tilts_are_found_from_far_away() -> None:
    pose, other = CameraPose(axial_rad=0.2, tilt_x_rad=0.3), CameraPose(axial_rad=-0.1, tilt_x_rad=0.3, tilt_y_rad=-0.1)
    tilted = Geometry(modulator_tilt_x_rad=-0.2, modulator_tilt_y_rad=0.4)
    device = Device(geometry=tilted, in_phase_camera=pose, quadrature_camera=other, drift=Drift(shift_px=0))
    truth = true_parameters(PROFILE, device)
    start, axial = truth.copy(), indices("axial", "tilt", "tilt_apart")
    start[axial] += [0.4, -0.2, 0.1, 0.2, -0.4, -0.3, 0.05, 0.2, -0.1]
    found = seen_by(device, 5).fit(start, device.homodyne.turn_rad, GROUPS, levels=LevelPrior())
    assert found.modulation is NOMINAL
    assert all(found.modulation_deviations)
    even = found.conditions.illumination[0]
    assert np.abs((found.conditions.illumination / even).imag).max() < 1e-9  # the launch alone bends phases
    off = ((found.parameters - truth) / np.maximum(found.deviations, 1e-12))[axial]
    assert np.sqrt(np.mean(off**2)) < 2
    assert np.rad2deg(abs(found.quadrature_phase - device.homodyne.turn_rad)) < 0.3


def test_what_the_modulator_makes_of_its_levels_comes_back_with_calibrated_deviations() -> None:
    slm = SlmDefects(stroke_relative_error=-0.08, level_sine_rad=0.2, level_cosine_rad=0.1, unmodulated_relative=0.1)
    slm = slm.model_copy(update={"blur_px": 0.45, "crosstalk_relative": 0.02})
    device = Device(slm=slm, drift=Drift(shift_px=0))
    start, truth = true_parameters(PROFILE, device), true_modulation(slm, PROFILE)
    found = seen_by(device, 2).fit(start, device.homodyne.turn_rad, GROUPS, levels=LevelPrior())
    off = np.array(found.modulation.coefficients) - truth.coefficients
    assert np.sqrt(np.mean((off / found.modulation_deviations) ** 2)) < 2
    assert found.conditions.blur == pytest.approx(slm.blur_px**2, abs=0.02)
    # of levels: what a decision among 256 of them notices is a tenth of their distance, the noise of most pages 0.02
    phases = found.modulation.phases(256) - truth.phases(256)
    assert np.std(phases) < 0.003 < 0.1 < np.std(truth.phases(256) - symbol_phases(np.arange(256), 256))


@pytest.mark.parametrize("stroke", [0.0, -0.02])
def test_a_re_fit_finds_a_stroke_that_has_changed_and_else_leaves_the_levels_as_they_were(stroke: float) -> None:
    slm = SlmDefects(level_sine_rad=0.1, unmodulated_relative=0.05)
    earlier, later = (
        true_modulation(slm.model_copy(update={"stroke_relative_error": by}), PROFILE) for by in (0.0, stroke)
    )
    device = Device(slm=slm.model_copy(update={"stroke_relative_error": stroke}), drift=Drift(shift_px=0))
    start, drift = true_parameters(PROFILE, device), LevelPrior(earlier, DRIFTS)
    found = seen_by(device, 2).fit(start, device.homodyne.turn_rad, ("in_phase",), modulation=earlier, levels=drift)
    assert (found.modulation is earlier) == (stroke == 0)
    off = np.array(found.modulation.coefficients) - later.coefficients
    assert abs(off[0]) < 3 * found.modulation_deviations[0] < 0.006
    assert np.abs(off[1:]).max() < 0.02
