"""A further pass: what an estimated page leaves unexplained says where, and which way, the estimate is wrong."""

from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy import special

from lightpage.calibration.calibrate import KnownPage
from lightpage.calibration.waves.wave_model import illumination_terms
from lightpage.device.state import Device, Drift, Sensor
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.data.features import FeatureExtractor
from lightpage.train.data.known_light import explained
from lightpage.train.models.parts import turned
from lightpage.train.models.prediction import Prediction, expected_phasors
from lightpage.train.trainers.refinement import fit_prediction
from tests.lightpage.small import small_profile

PROFILE = small_profile()
SURE = 1e4


class Known(NamedTuple):
    pair: FramePair
    phases: np.ndarray
    extractor: FeatureExtractor
    prediction: Prediction


def known_page(**device: object) -> Known:
    state = Device(**device)  # type: ignore[arg-type]
    simulator = Simulator(PROFILE, state, seed=5)
    symbols = random_symbols(PROFILE, 256, 1, np.random.default_rng(5))[0]
    recorded, phases = simulator.simulate(symbols), symbol_phases(symbols, 256)
    extractor = FeatureExtractor(perfectly_calibrated(PROFILE, state, simulator.references()))
    known = KnownPage(recorded.pair, np.exp(1j * phases))
    return Known(recorded.pair, phases, extractor, fit_prediction(extractor, explained(extractor, [known])))


@pytest.fixture(scope="module")
def dim() -> Known:
    return known_page(sensor=Sensor(full_well_e=100), drift=Drift(piston_rad=0.5, shift_px=0.2))


def unexplained(known: Known, estimated: np.ndarray) -> np.ndarray:
    """Light [ny, nx] that sure estimates of phases leave, against them."""
    state = known.extractor.state(known.extractor.field(known.pair), known.phases, np.zeros(2))
    measured, field = known.extractor.measure(known.pair, state.shift_px)
    p = SURE * torch.from_numpy(np.stack([np.cos(estimated), np.sin(estimated)]).astype(np.float32))
    light = known.prediction(known.extractor.recovery, measured, field, turned(p, state.piston_rad))
    seen = turned(light, -state.piston_rad).numpy()[:, 0].mean(1)
    return (seen[0] + 1j * seen[1]) * np.exp(-1j * estimated)


def test_expected_phasors_are_as_long_as_their_bessel_functions_say() -> None:
    kappa = np.concatenate([[0.0], np.geomspace(0.01, 1e4, 500)])
    expected = special.i1e(kappa) / special.i0e(kappa)
    found = expected_phasors(torch.from_numpy(np.stack([0.6 * kappa, 0.8 * kappa])))
    np.testing.assert_allclose(found, np.array([[0.6], [0.8]]) * expected, rtol=0.05)


def test_symbols_that_are_wrong_pull_towards_what_was_written(dim: Known) -> None:
    wrong = np.zeros(PROFILE.page_shape)
    wrong[3::7, 2::9] = 0.3
    wrong[5::7, 4::9] = -0.3
    pull = unexplained(dim, dim.phases + wrong).imag
    for error in (0.3, -0.3):
        there = pull[wrong == error]
        assert np.all(np.sign(error) * there < 0)
        assert abs(there.mean()) > 8 * pull[wrong == 0].std() / np.sqrt(there.size)
    assert abs(pull[wrong == 0].mean()) < 0.2 * abs(pull[wrong == 0.3].mean())


def test_illumination_and_floor_are_those_of_the_device(dim: Known) -> None:
    by_term = dim.prediction.illumination.numpy()[0]
    corner = float(np.tensordot(by_term, np.stack(illumination_terms(np.ones(1), np.ones(1))), 1)[0, 0])
    assert corner / by_term[0] == pytest.approx(1 - Device().slm.falloff_relative, abs=0.04)
    bright = known_page(sensor=Sensor(full_well_e=100, read_noise_e=0.1))
    assert bright.prediction.floor < 0.6 * dim.prediction.floor
