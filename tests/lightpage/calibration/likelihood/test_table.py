"""Claims about the tensors of maximum likelihood: the modulator's amplitude over its phase, and known pilots."""

import numpy as np

from lightpage.calibration.likelihood.table import HARMONICS, amplitude_series, pilot_tensors
from lightpage.device.state import SlmDefects
from lightpage.page.modulation import NOMINAL
from lightpage.page.pilots import Pilots
from lightpage.simulator.true_optics import true_modulation
from tests.lightpage.small import random_phases, small_profile

PROFILE = small_profile()


def test_the_series_gives_the_amplitude_of_light_by_its_phase() -> None:
    modulation = true_modulation(SlmDefects(unmodulated_relative=0.1, unmodulated_phase_rad=0.4), PROFILE)
    light = modulation.light(np.linspace(0.1, 6.2, 301))
    series, phase = amplitude_series(modulation).astype(float), np.angle(light)
    harmonics = np.arange(1, HARMONICS + 1)[:, None] * phase
    found = np.exp(series[0] + series[1::2] @ np.cos(harmonics) + series[2::2] @ np.sin(harmonics))
    assert np.ptp(np.abs(light)) > 0.15
    np.testing.assert_allclose(found, np.abs(light), atol=2e-3)


def test_a_nominal_modulator_has_no_series() -> None:
    np.testing.assert_allclose(amplitude_series(NOMINAL), 0, atol=1e-7)


def test_pilots_become_phasors_at_their_places() -> None:
    phases = random_phases(PROFILE)
    mask = np.random.default_rng(0).random(phases.shape) < 0.1
    tensors = pilot_tensors(Pilots(mask, phases[mask]))
    phasors = tensors["pilot_phasors"][0] + 1j * tensors["pilot_phasors"][1]
    np.testing.assert_array_equal(tensors["pilot_mask"], mask)
    np.testing.assert_allclose(phasors[mask], np.exp(1j * phases[mask]), atol=1e-6)
    assert {tensor.dtype for tensor in tensors.values()} == {np.dtype(np.float32)}
