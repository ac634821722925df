"""Claims about the verdict on a fit: a right one is good whatever the noise, a wrong one is not and says why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightpage.calibration.goodness.frame_noise import noise_like, noise_variance
from lightpage.calibration.goodness.measure import measure_goodness
from lightpage.calibration.goodness.verdict import Goodness
from lightpage.calibration.parameters import NAMES
from lightpage.calibration.waves.wave_fit import LevelPrior, WaveFit
from lightpage.device.state import Device
from lightpage.page.symbols import symbol_phases
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import small_profile

PROFILE = small_profile()
TWIN = TorchTwin(RayTwin(PROFILE))
STILL = ("drift.shift_px=0",)


def goodness_of(*settings: str, wrong_symbols: float = 0.0, stated: float = 1.0) -> Goodness:
    """Return the goodness of a calibration that knows all of a device but what it has no parameter for.

    The profile states `stated` times the pipe's length.
    """
    device = Device().with_settings([*STILL, *settings])
    simulator = Simulator(PROFILE, device, seed=3)
    rng = np.random.default_rng(3)
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
    return measure_goodness(TWIN, fitted, found.conditions, pair, told)


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


def test_a_frames_noise_is_known_by_the_frame_itself() -> None:
    rng = np.random.default_rng(0)
    light = 120 + 80 * np.cos(np.arange(400) * 0.5)[:, None] * np.cos(np.arange(300) * 0.4)
    frame = rng.normal(light, np.sqrt(2 + 0.05 * light)).round().astype(np.uint8)
    frame[rng.random(frame.shape) < 1e-3] = 255
    fixed, by_count = noise_variance(frame)
    assert fixed + 120 * by_count == pytest.approx(8, rel=0.1)
    assert np.var(noise_like(frame, rng)) == pytest.approx(8, rel=0.15)
    few = np.clip(np.rint(8 * rng.poisson(light / 8)), 0, 255).astype(np.uint8)  # electrons, eight counts each
    assert np.var(noise_like(few, rng)) == pytest.approx(8 * light.mean(), rel=0.05)
    frame[:100] = 255
    fixed, by_count = noise_variance(frame)
    assert fixed + 120 * by_count == pytest.approx(8, rel=0.1)
