"""Localizers on simulated light: the features of a symbol show that symbol."""

import numpy as np
import pytest

from lightpage.calibration.coherence import COHERENT_BRANCHES, branch_shares
from lightpage.device.state import Device, Drift, SlmDefects
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.train.data.features import FeatureExtractor
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.waves.grid import GRID_STEP_PX
from tests.lightpage.small import small_profile

SEED = 3


@pytest.fixture(scope="module", params=[GRID_STEP_PX, 3])
def page(request: pytest.FixtureRequest) -> tuple[np.ndarray, dict[str, np.ndarray], FeatureExtractor]:
    profile = small_profile()
    device = Device(slm=SlmDefects(phase_noise_rad=0), drift=Drift(piston_rad=1.0, shift_px=0.3))
    simulator = Simulator(profile, device, seed=SEED)
    symbols = random_symbols(profile, 256, 1, np.random.default_rng(SEED))[0]
    recorded = simulator.simulate(symbols)
    phases = symbol_phases(symbols, 256)
    perfect, features = perfectly_calibrated(profile, device, simulator.references()), {}
    for localizer in ("coherent", "wave"):
        extractor = FeatureExtractor(perfect, localizer, Hyperparameters(field_step=request.param))
        found, shift = extractor.page(extractor.field(recorded.pair), phases, np.zeros(2))
        features[localizer] = found.light.astype(np.float32)
        np.testing.assert_allclose(shift, recorded.shift_px, atol=0.1)
    return phases, features, extractor


def test_the_coherent_localizer_brings_out_each_symbol_where_its_branch_has_the_light(page) -> None:
    phases, features, extractor = page
    light = features["coherent"]
    symbol = (light[0] + 1j * light[1]).mean(1)[: len(COHERENT_BRANCHES)]
    shares = branch_shares(extractor.table["positions"].reshape(2, -1).T.astype(float)).reshape(symbol.shape)
    for branch in range(len(COHERENT_BRANCHES)):
        clean = shares[branch] > 0.5
        assert clean.sum() >= 60
        z = symbol[branch][clean] * np.exp(-1j * phases[clean])
        assert abs(z.mean()) / np.sqrt(np.mean(np.abs(z) ** 2)) > 0.95
        assert abs(np.angle(z.mean())) < 0.02


def test_the_wave_localizer_brings_out_nearly_all_of_the_page(page) -> None:
    phases, features, _ = page
    light = features["wave"]
    symbol = (light[0, 0] + 1j * light[1, 0]).mean(0) * np.exp(-1j * phases)
    assert abs(symbol.mean()) / np.sqrt(np.mean(np.abs(symbol) ** 2)) > 0.85
