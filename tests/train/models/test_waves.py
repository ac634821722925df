"""The wave model in torch against the one in numpy, both ways."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lightpage.calibration.parameters import NAMES, PRIORS, nominal
from lightpage.calibration.wave_model import FittedWaves
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.simulator.true_optics import true_parameters
from tests.lightpage.small import THICK, small_profile
from train.models.parts import stacked
from train.models.waves import ACCURACY, Waves

PROFILE = small_profile()
SAMPLES = 4


@pytest.fixture(
    scope="module",
    params=[(0.0, True, False), (-0.01, True, False), (-0.01, False, False), (-0.01, True, True)],
    ids=["square", "sheared", "points", "real lenses"],
)
def models(request: pytest.FixtureRequest) -> tuple[FittedWaves, Waves, float]:
    """The two models, and how far they may differ: torch takes fewer terms for real lenses."""
    angle_rad, filled, thick = request.param
    profile = PROFILE.model_copy(update={"lens_path": THICK}) if thick else PROFILE
    parameters = true_parameters(profile, Device())
    parameters[NAMES.index("pipe_angle_rad")] = angle_rad
    fitted = FittedWaves(profile, parameters, SAMPLES, filled=filled, accuracy=ACCURACY)
    return fitted, Waves(profile, parameters, filled=filled), 0.02 if thick else 1e-3


def noise(shape: tuple[int, ...]) -> np.ndarray:
    rng = np.random.default_rng(0)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


def check(found: torch.Tensor, expected: np.ndarray, error: float = 1e-3) -> None:
    assert np.linalg.norm(found[0].numpy() + 1j * found[1].numpy() - expected) < error * np.linalg.norm(expected)


def test_a_page_lights_the_camera_as_in_the_fitted_waves(models: tuple[FittedWaves, Waves, float]) -> None:
    page = noise(models[0].launch.shape)
    check(models[1].to_camera(models[1].matrices(), stacked(page)), models[0].to_camera(page), models[2])


def test_a_field_comes_back_to_the_page_as_in_the_fitted_waves(models: tuple[FittedWaves, Waves, float]) -> None:
    field = noise(models[0].against_reference.shape)
    check(models[1].to_page(models[1].matrices(), stacked(field)), models[0].to_page(field), models[2])


def test_the_full_size_device_is_small_enough_to_be_exported() -> None:
    profile = load_profile("paper")
    waves = Waves(profile, nominal(), filled=True)
    assert sum(buffer.nbytes for buffer in waves.buffers()) < 30e6


def test_other_parameters_make_the_waves_of_the_device_that_has_drifted() -> None:
    parameters = true_parameters(PROFILE, Device())
    drifted = parameters + 0.02 * PRIORS
    drifted[NAMES.index("page_centre_y_m")] -= 0.02 * PRIORS[NAMES.index("page_centre_y_m")]  # it changes the sampling
    expected, waves = (
        FittedWaves(PROFILE, drifted, SAMPLES, filled=True, accuracy=ACCURACY),
        Waves(PROFILE, parameters, filled=True),
    )
    page = noise(expected.launch.shape)
    check(waves.to_camera(waves.matrices(torch.from_numpy(drifted).float()), stacked(page)), expected.to_camera(page))
