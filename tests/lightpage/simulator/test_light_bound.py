"""Claims about the bound of the light."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from analysis.comparison import bound
from lightpage.device.state import Device, Sensor, SlmDefects
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.simulator.light_bound import LightBound
from lightpage.simulator.true_optics import TrueOptics
from tests.lightpage.small import small_profile

PROFILE = small_profile()
UNEVEN = SlmDefects(phase_noise_rad=0, stroke_relative_error=-0.02, level_sine_rad=0.1, crosstalk_relative=0.02)


@pytest.mark.parametrize("electrons", [30.0, 15_000.0])
def test_it_is_what_a_small_change_of_the_symbol_does_to_the_counts(electrons: float) -> None:
    sensor = Sensor(full_well_e=electrons, bit_depth=12, read_noise_e=1.0)
    device = Device(slm=UNEVEN, sensor=sensor).of_profile(PROFILE)
    symbols = random_symbols(PROFILE, 16, 1, np.random.default_rng(0))[0]
    optics, row, column, size = TrueOptics(PROFILE, device), 3, 5, PROFILE.page.symbol_size_px
    x, y = optics.camera_axes_m
    half_y, half_x = np.array(PROFILE.frame_shape) * PROFILE.camera.pitch_m / 2
    inside = np.abs(y) <= half_y, np.abs(x) <= half_x

    def counts(step: float) -> np.ndarray:
        phases = symbol_phases(symbols, 16)
        phases[row, column] += step
        field = optics.camera_field(optics.exit_field(np.kron(phases, np.ones((size, size)))))
        turn, gain = np.exp(1j * device.homodyne.turn_rad), device.homodyne.quadrature_gain
        both = np.stack([field, field * np.conj(turn)]) + optics.reference_in_place
        light = np.abs(both) ** 2 * np.array([1, gain])[:, None, None] * optics.electrons_per_unit
        return np.asarray(light[:, inside[0]][:, :, inside[1]])

    rate, variance = (counts(0.01) - counts(-0.01)) / 0.02, counts(0.0) + 1.0 + (electrons / 4095) ** 2 / 12
    expected = np.sum(rate**2 / variance * (counts(0.0) < electrons))
    assert LightBound(PROFILE, device, symbols, 16).concentration(row, column) == pytest.approx(expected, rel=2e-3)
    noisy = device.model_copy(update={"slm": UNEVEN.model_copy(update={"phase_noise_rad": 0.5})})
    assert 1 / LightBound(PROFILE, noisy, symbols, 16).concentration(row, column) == pytest.approx(
        1 / expected + (0.5 / size) ** 2, rel=2e-3
    )


def test_the_command_goes_on_where_it_was(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(PROFILE.to_toml())
    file = tmp_path / "bound.json"
    words = ["--profile", str(tmp_path / "small.toml"), "--symbols", "3", "--json", str(file)]
    assert CliRunner().invoke(bound.main, [*words, "--pages", "1"]).exit_code == 0
    found = json.loads(file.read_text())
    file.write_text(json.dumps(found | {"concentrations": [[1.0] * 3]}))
    assert CliRunner().invoke(bound.main, [*words, "--pages", "2"]).exit_code == 0
    first, second = json.loads(file.read_text())["concentrations"]
    assert (first, len(second)) == ([1.0] * 3, 3)
    assert CliRunner().invoke(bound.main, [*words, "--seed", "1"]).exit_code
