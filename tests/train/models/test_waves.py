"""The wave model in torch against the one in numpy, both ways."""

import numpy as np
import pytest
import torch

from lightpage.calibration.parameters import NAMES, PRIORS
from lightpage.calibration.waves.wave_model import FittedWaves, on_modulator
from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models import wave_lens, wave_pipe
from lightpage.train.models.parts import stacked
from lightpage.train.models.waves import EXACT, ROUGH, Banded, Fidelity, Waves
from tests.lightpage.small import THICK, small_profile

PROFILE = small_profile()
SAMPLES = 4
FINE = Fidelity(1e-3, 1e-3)
ERROR = 0.01
"""Error of that fidelity, and of light on sparse samples."""


def device(angle_rad: float, *, thick: bool = False, roll_rad: float | None = None) -> tuple[Profile, np.ndarray]:
    """A profile and parameters."""
    profile = PROFILE.model_copy(update={"lens_path": THICK}) if thick else PROFILE
    parameters = true_parameters(profile, Device())
    parameters[NAMES.index("pipe_angle_rad")] = angle_rad
    if roll_rad is not None:
        parameters[NAMES.index("pipe_roll_rad")] = roll_rad
    return profile, parameters


@pytest.fixture(
    scope="module",
    params=[(0.0, True, False, 1), (-0.01, False, False, 1), (-0.01, True, True, 3)],
    ids=["square", "points", "real lenses in tiles"],
)
def models(request: pytest.FixtureRequest) -> tuple[FittedWaves, Waves]:
    """The two models."""
    angle_rad, filled, thick, tiles = request.param
    profile, parameters = device(angle_rad, thick=thick)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wave_lens, "WAVES_A_TILE", wave_lens.WAVES_A_TILE / tiles**2)
        patch.setattr(wave_pipe, "MODES_A_BLOCK", 20 if tiles > 1 else wave_pipe.MODES_A_BLOCK)
        waves = Waves(profile, parameters, SAMPLES, FINE, filled=filled)
    assert any(name.endswith("blocks.1") for name, _ in waves.named_modules()) == (tiles > 1)
    return FittedWaves(profile, parameters, SAMPLES, filled=filled), waves


def noise(shape: tuple[int, ...]) -> np.ndarray:
    rng = np.random.default_rng(0)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


def distance(found: torch.Tensor, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found[0].numpy() + 1j * found[1].numpy() - expected) / np.linalg.norm(expected))


def test_a_page_lights_the_camera_as_in_the_fitted_waves(models: tuple[FittedWaves, Waves]) -> None:
    fitted, waves = models
    page = noise(fitted.launch.shape)
    assert distance(waves.to_camera(waves.matrices(), stacked(page)), fitted.to_camera(page)) < ERROR


def test_a_field_comes_back_to_the_page_as_in_the_fitted_waves(models: tuple[FittedWaves, Waves]) -> None:
    fitted, waves = models
    field = fitted.to_camera(noise(fitted.launch.shape))
    assert distance(waves.to_page(waves.matrices(), stacked(field)), fitted.to_page(field)) < ERROR


@pytest.mark.parametrize(("fidelity", "at_most", "roll_deg"), [(EXACT, 0.04, 0.4), (ROUGH, 0.12, -0.4)])
def test_light_is_followed_as_exactly_as_is_asked(fidelity: Fidelity, at_most: float, roll_deg: float) -> None:
    profile, parameters = device(-0.01, thick=True, roll_rad=float(np.deg2rad(roll_deg)))
    page = on_modulator(np.exp(2j * np.pi * np.random.default_rng(2).random(profile.page_shape)), SAMPLES)
    expected = FittedWaves(profile, parameters, SAMPLES, filled=True).to_camera(page)
    waves = Waves(profile, parameters, SAMPLES, fidelity, filled=True)
    assert distance(waves.to_camera(waves.matrices(), stacked(page)), expected) < at_most


def test_one_filled_sample_stands_for_a_symbol() -> None:
    profile, parameters = device(-0.01)
    symbols = np.exp(2j * np.pi * np.random.default_rng(2).random(profile.page_shape))
    expected = FittedWaves(profile, parameters, SAMPLES, filled=True).to_camera(on_modulator(symbols, SAMPLES))
    waves = Waves(profile, parameters, 1, FINE, filled=True)
    found = waves.to_camera(waves.matrices(), stacked(SAMPLES * symbols))
    assert distance(found, expected) < 0.05  # phases vary within the symbols of so small a page


def test_other_parameters_make_the_waves_of_the_device_that_has_drifted() -> None:
    parameters = true_parameters(PROFILE, Device())
    drifted = parameters + 0.02 * PRIORS
    drifted[NAMES.index("page_centre_y_m")] -= 0.02 * PRIORS[NAMES.index("page_centre_y_m")]  # it changes the sampling
    expected, waves = (
        FittedWaves(PROFILE, drifted, SAMPLES, filled=True),
        Waves(PROFILE, parameters, SAMPLES, FINE, filled=True),
    )
    page = noise(expected.launch.shape)
    found = waves.to_camera(waves.matrices(torch.from_numpy(drifted).float()), stacked(page))
    assert distance(found, expected.to_camera(page)) < ERROR


def test_a_banded_matrix_multiplies_as_a_full_one() -> None:
    rows, columns = np.meshgrid(np.arange(150), np.arange(90), indexing="ij")
    matrix = np.where(np.abs(0.6 * rows - columns) < 9, rows + columns, 0.0)
    light = torch.randn(2, 90, 7, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(Banded(matrix)(light), torch.from_numpy(matrix).float() @ light, rtol=1e-4, atol=1e-3)
