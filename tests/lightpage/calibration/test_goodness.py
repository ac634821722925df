"""Claims about the verdict on a fit: a right one is good whatever the noise, a wrong one is not and says why."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.goodness.camera_faults import passed_light
from lightpage.calibration.goodness.frame_noise import noise_curve, noise_like, on_pixels
from lightpage.calibration.goodness.ghost import ghost_amplitude
from lightpage.calibration.goodness.light import PageLight
from lightpage.calibration.goodness.measure import ShownPage, measure_goodness
from lightpage.calibration.goodness.page_errors import outliers
from lightpage.calibration.goodness.verdict import Goodness
from lightpage.calibration.goodness.walls import WallDifference, wall_difference
from lightpage.calibration.parameters import NAMES
from lightpage.calibration.waves.wave_fit import LevelPrior, WaveFit
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.device.state import Device, Sensor
from lightpage.page.symbols import symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.cameras import Blemishes, to_counts
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import small_profile

PROFILE = small_profile()
TWIN = TorchTwin(RayTwin(PROFILE))
STILL = ("drift.shift_px=0",)


def fitted_page(
    *settings: str, wrong_symbols: float = 0.0, stated: float = 1.0, page: int = 0
) -> tuple[CalibratedDevice, LaunchConditions, FramePair, NDArray[np.complex128]]:
    """Return a calibration that knows all of a device but what it has no parameter for, and a page as it is known.

    The profile states `stated` times the pipe's length. Pages of other numbers have other symbols.
    """
    device = Device().with_settings([*STILL, *settings])
    simulator = Simulator(PROFILE, device, seed=3)
    rng = np.random.default_rng([3, page] if page else 3)
    symbols = rng.integers(256, size=PROFILE.page_shape).astype(np.uint8)
    pair, references = simulator.page(symbols), simulator.references()
    replaced = rng.random(symbols.shape) < wrong_symbols
    told = np.exp(1j * symbol_phases(np.where(replaced, rng.integers(256, size=symbols.shape), symbols), 256))
    known = perfectly_calibrated(PROFILE, device, references)
    fit = WaveFit(TWIN, PROFILE, pair, references, told)
    start, levels = (known.parameters, known.quadrature_phase_rad), LevelPrior()
    found = fit.fit(*start, ("camera_phase",), modulation=known.modulation, levels=levels)
    pipe, parameters = PROFILE.pipe, known.parameters.copy()
    profile = PROFILE.model_copy(update={"pipe": pipe.model_copy(update={"length_m": stated * pipe.length_m})})
    length = NAMES.index("pipe_length_relative")
    parameters[length] = (1 + parameters[length]) / stated - 1
    fitted = replace(known, profile=profile, parameters=parameters, modulation=found.modulation)
    return fitted, found.conditions, pair, told


def goodness_of(*settings: str, wrong_symbols: float = 0.0, stated: float = 1.0) -> Goodness:
    """Return the goodness of such a calibration."""
    return measure_goodness(TWIN, [ShownPage(*fitted_page(*settings, wrong_symbols=wrong_symbols, stated=stated))])


def true_variance(sensor: Sensor, expected: float, count: int = 100_000) -> float:
    """Variance of the counts of a pixel that a perfect camera would give `expected` counts."""
    rng = np.random.default_rng(1)
    light = rng.poisson(expected * sensor.full_well_e / (2**sensor.bit_depth - 1), count)
    counts = to_counts(light + sensor.read_noise_e * rng.standard_normal(count), sensor)
    return float(np.var(counts))


BLURRED, DIM = ("sensor.full_well_e=1000", "slm.blur_px=0.5"), ("sensor.full_well_e=32",)


@pytest.mark.parametrize("settings", [(), ("slm.phase_noise_rad=0.3",), BLURRED, DIM])
def test_a_right_fit_is_good_whatever_the_noise(settings: tuple[str, ...]) -> None:
    found = goodness_of(*settings)
    assert (found.verdict, found.cause) == ("good", "")
    assert np.median(found.by_page) == pytest.approx(1, abs=0.35)


def test_a_device_whose_profile_is_of_another_one_is_not_good_though_all_light_is_explained() -> None:
    found = goodness_of(stated=1.2)
    assert (found.verdict, found.bits_lost) == ("usable", pytest.approx(goodness_of().bits_lost, abs=0.01))
    assert "pipe length -16.7%" in found.cause
    assert goodness_of(stated=1.002).verdict == "good"


def test_the_modulators_noise_is_told_from_light_that_nothing_explains() -> None:
    assert goodness_of("slm.phase_noise_rad=0.1").modulator_noise_rad == pytest.approx(0.1, rel=0.2)
    assert goodness_of("slm.phase_noise_rad=3").bits_lost > 3  # no modulator has as much


@pytest.mark.parametrize(
    ("settings", "wrong_symbols", "cause"),
    [
        (("geometry.ghost_relative=0.15",), 0.0, "three times"),
        (("geometry.pipe_height_relative_error=0.003",), 0.0, "walls of the pipe"),
        (("sensor.dust_specks=40", "sensor.hot_pixel_share=0.003"), 0.0, "few places"),
        (("slm.crosstalk_relative=0.2",), 0.0, "crosstalk"),
        ((), 0.5, "other symbols"),
    ],
)
def test_a_wrong_fit_says_what_is_likeliest(settings: tuple[str, ...], wrong_symbols: float, cause: str) -> None:
    found = goodness_of(*settings, wrong_symbols=wrong_symbols)
    assert found.verdict == "wrong"
    assert cause in found.cause
    assert np.max(found.by_facet) > 3


def test_noise_in_dim_light_hides_no_fault_and_looks_like_none() -> None:
    """Counts at 32 electrons are clipped at zero, which no wave explains."""
    assert goodness_of(*DIM).bits_lost < 0.03
    ghost = "geometry.ghost_relative=0.15"
    dim, bright = goodness_of(*DIM, ghost), goodness_of(ghost)
    assert dim.verdict == "wrong"
    assert dim.unexplained_relative == pytest.approx(bright.unexplained_relative, rel=0.15)


def test_counts_that_are_not_in_proportion_to_the_light_cost_nothing() -> None:
    bent, straight = goodness_of("sensor.nonlinearity_relative=-0.15"), goodness_of()
    assert bent.bits_lost == pytest.approx(straight.bits_lost, abs=0.01)


@pytest.mark.parametrize("settings", [DIM, BLURRED, ("sensor.bit_depth=12",)])
def test_the_noise_of_the_verdict_is_that_of_the_sensor_at_every_brightness(settings: tuple[str, ...]) -> None:
    sensor = Device().with_settings(settings).sensor
    known, conditions, pair, symbols = fitted_page(*settings)
    light = PageLight(TWIN, known, conditions, pair, symbols)
    light.correct_amplitude()
    for frame, expected in zip((pair.in_phase, pair.quadrature), light.expected_frames(), strict=True):
        levels = np.geomspace(*np.nanquantile(expected, [0.05, 0.98]), 6)
        true = [true_variance(sensor, level) for level in levels]
        np.testing.assert_allclose(noise_curve(frame, expected).at(levels), true, rtol=0.15)


def test_defects_and_saturated_pixels_are_no_noise() -> None:
    rng = np.random.default_rng(0)
    light = (120 + 80 * np.cos(np.arange(400) * 0.5)[:, None] * np.cos(np.arange(300) * 0.4)).astype(np.float32)
    frame = rng.normal(light, np.sqrt(2 + 0.05 * light)).round().astype(np.uint8)
    frame[rng.random(frame.shape) < 1e-3] = 255
    curve = noise_curve(frame, light)
    np.testing.assert_allclose(curve.at(np.array([60, 120, 180])), [5, 8, 11], rtol=0.15)
    assert np.var(noise_like(frame, light, rng)) == pytest.approx(8, rel=0.1)
    frame[:100], light[:100] = 255, 300
    curve = noise_curve(frame, light)
    np.testing.assert_allclose(curve.at(np.array([60, 120, 180])), [5, 8, 11], rtol=0.15)
    assert curve.at(np.array([300.0])) == pytest.approx(0, abs=0.5)


def test_pixels_that_the_grid_does_not_reach_are_no_noise_either() -> None:
    rng = np.random.default_rng(0)
    light = np.full((600, 500), 100, np.float32)
    frame = rng.poisson(light).astype(np.uint16)
    frame[:200], light[:200] = 30 * rng.poisson(3, (200, 500)), np.nan
    assert noise_curve(frame, light).at(np.array([100.0])) == pytest.approx(100, rel=0.1)
    assert np.isfinite(noise_like(frame, light, rng)).all()
    assert not noise_like(frame, np.full_like(light, np.nan), rng).any()


def test_values_of_the_grid_come_to_the_pixels_that_see_them() -> None:
    rows, columns = np.indices((60, 80)).astype(np.float64)

    def wave(row: np.ndarray, column: np.ndarray) -> np.ndarray:
        return np.cos(0.9 * row) * np.sin(0.7 * column + 0.3)

    turned = [150 - 2.02 * columns + 0.03 * rows + 1e-4 * rows * columns, 12 + 1.98 * rows - 0.02 * columns]
    image = on_pixels(wave(rows, columns), turned, (160, 140))
    at = np.rint(turned).astype(int)
    inside = (slice(8, -8), slice(8, -8))
    near = image[at[0], at[1]]
    back = np.linalg.inv([[0.03, -2.02], [1.98, -0.02]])
    off = np.stack([at[0] - turned[0], at[1] - turned[1]])
    row, column = np.stack([rows, columns]) + np.tensordot(back, off, 1)
    np.testing.assert_allclose(near[inside], wave(row, column)[inside], atol=0.03)
    assert np.isnan(image[:, -1]).all()


@pytest.mark.parametrize(
    ("setting", "name"),
    [
        ("sensor.black_level_relative=0.05", "black level"),
        ("reference.recorded_exposure_relative=1.1", "reference exposure"),
        ("drift.vibration_rad=0.4", "vibration"),
        ("sensor.late_dust_specks=12", "dust"),
        ("geometry.ghost_relative=0.04", "ghost"),
    ],
)
def test_a_fault_of_the_bench_is_the_largest_cause(setting: str, name: str) -> None:
    found = measure_goodness(TWIN, [ShownPage(*fitted_page(setting))], explained_from=0.0)
    assert found.causes[0].name == name
    assert found.causes[0].remedy


def test_dead_pixels_of_the_modulator_are_named_and_spoil_no_other_estimate() -> None:
    shown = [ShownPage(*fitted_page("slm.dead_pixel_share=0.002", page=page)) for page in range(2)]
    found = measure_goodness(TWIN, shown, explained_from=0.0)
    assert [cause.name for cause in found.causes][:1] == ["dead modulator pixels"]
    assert found.bits_lost < 0.1
    assert found.modulator_noise_rad == pytest.approx(goodness_of().modulator_noise_rad, rel=0.1)


def test_outliers_are_symbols_that_are_wrong_on_every_page_by_either_camera() -> None:
    rng = np.random.default_rng(0)
    shape = (2, 2, 50, 80)
    noise = rng.standard_normal(shape) * 0.005 + 1j * rng.standard_normal(shape) * 0.02
    assert not outliers([*noise]).any()
    pages = noise.copy()
    pages[..., 3, 4] -= 0.06  # dark: the amplitude stands out, the magnitude does not
    pages[1, :, 5, 6] += 0.5  # wrong on one page alone
    pages[:, 1, 7, 8] -= 0.5  # dust on one camera
    pages *= np.linspace(1, 10, shape[-1])  # one side is explained worse
    assert [*zip(*np.nonzero(outliers([*pages])), strict=True)] == [(3, 4)]
    assert not outliers([*(noise + (rng.random(shape[2:]) < 0.2))]).any()  # symbols that were not written


def test_dust_that_settled_after_the_references_is_found_where_it_is() -> None:
    camera, sensor = PROFILE.camera, Device().with_settings(["sensor.late_dust_specks=6"]).sensor
    found = measure_goodness(TWIN, [ShownPage(*fitted_page("sensor.late_dust_specks=6"))], explained_from=0.0)
    dust = next(cause for cause in found.causes if cause.name == "dust")
    named = re.search(r"quadrature camera: \d+ specks? at \((\d+), (\d+)\)", dust.what)
    assert named is not None
    column, row = map(int, named.groups())
    passed = Blemishes.of(camera, sensor, 1).late_transmission
    assert np.min(np.asarray(passed)[row - 2 : row + 3, column - 2 : column + 3]) < 0.8


def test_the_light_that_passes_dust_is_measured_at_each_pixel() -> None:
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:120, :160]
    speck = 1 - 0.6 * np.exp(-((rows - 50) ** 2 + (columns - 70) ** 2) / (2 * 3.0**2))
    expected = [np.float32(1000 * rng.gamma(2, size=rows.shape)) for _ in range(2)]
    frames = [rng.poisson(speck * each) for each in expected]
    passed = passed_light(frames, expected)
    assert (passed[:40] == 1).all()
    np.testing.assert_allclose(passed[44:57, 64:77], speck[44:57, 64:77], atol=0.1)
    assert (passed_light([rng.poisson(each) for each in expected], expected) == 1).all()


def test_vibration_costs_the_contrast_and_what_the_model_lacks_by_it() -> None:
    found = measure_goodness(TWIN, [ShownPage(*fitted_page("drift.vibration_rad=0.4"))], explained_from=0.0)
    lost_contrast = 0.4**2 / 2 / np.log(2)
    assert 0.9 * lost_contrast < found.causes[0].bits < 2 * lost_contrast


def test_a_good_fit_has_no_causes() -> None:
    assert measure_goodness(TWIN, [ShownPage(*fitted_page())], explained_from=0.0).causes == ()


@pytest.mark.parametrize("amplitude", [0.0, 0.02, 0.06])
def test_the_amplitude_of_light_that_passes_three_times_is_right_within_its_deviations(amplitude: float) -> None:
    device, conditions, pair, symbols = fitted_page(f"geometry.ghost_relative={amplitude}")
    measured = ghost_amplitude(PageLight(TWIN, device, conditions, pair, symbols))
    assert measured.relative == pytest.approx(amplitude, abs=max(0.1 * amplitude, 3 * measured.deviation)), measured
    assert measured.deviation < 0.002


@pytest.mark.long
@pytest.mark.parametrize("difference", [0.0, -0.002])
def test_the_difference_of_height_and_width_is_right_within_its_deviations(difference: float) -> None:
    known, conditions, pair, symbols = fitted_page(f"geometry.pipe_height_relative_error={difference}")
    measured = wall_difference(PageLight(TWIN, known, conditions, pair, symbols))
    assert measured is not None
    assert measured.relative == pytest.approx(difference, abs=max(5 * measured.deviation, 0.1 * abs(difference)))
    assert measured.deviation < 2e-4


def test_the_difference_of_height_and_width_is_stated_in_micrometres() -> None:
    assert str(WallDifference(-0.001, 2e-5, 0.89e-3)) == " (height minus width: -0.890 +- 0.018 um)"
