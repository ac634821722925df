"""Claims about the table `statistics` of a calibration: it comes back from TOML, and a mistake in it is named."""

import tomllib

import numpy as np
import pytest

from lightpage.calibration.likelihood.counts import CountStatistics
from lightpage.calibration.likelihood.statistics import Statistics
from lightpage.calibration.waves.wave_model import ILLUMINATIONS, LaunchConditions
from lightpage.device.profile import to_toml, validate
from lightpage.errors import ProfileError

CAMERA = CountStatistics(expected=(0.0, 1.0, 2.0, 3.0), mean=(0.0, 1.0, 2.0, 3.0), variance=(1.0,) * 4)
STATISTICS = Statistics.of(LaunchConditions(np.arange(ILLUMINATIONS) * (1 + 0.5j), 0.25), (CAMERA, CAMERA), 1.5)


def test_it_comes_back_from_toml() -> None:
    assert validate(Statistics, tomllib.loads(to_toml(STATISTICS)), "calibration C.toml") == STATISTICS


@pytest.mark.parametrize(
    ("key", "values", "problem"),
    [
        ("in_phase_expected", "[0.0, 2.0, 1.0, 3.0]", "in_phase_expected with 1 after 2"),
        ("quadrature_mean", "[0.0, 1.0]", "quadrature_mean of 2 numbers"),
        ("quadrature_variance", "[1.0, 1.0, 0.0, 1.0]", "quadrature_variance of 0"),
        ("in_phase_mean", "[0.0, nan, 2.0, 3.0]", "in_phase_mean.1 = nan .wanted a finite number"),
        ("illumination_real", "[1.0]", f"illumination_real = .1.0. .wanted at least {ILLUMINATIONS} entries"),
        ("blur", "-0.1", "blur = -0.1 .wanted at least 0"),
        ("correlation", "0.0", "correlation = 0.0 .wanted more than 0"),
    ],
)
def test_a_mistake_is_named(key: str, values: str, problem: str) -> None:
    lines = [f"{key} = {values}" if line.startswith(f"{key} =") else line for line in to_toml(STATISTICS).splitlines()]
    with pytest.raises(ProfileError, match=problem) as caught:
        validate(Statistics, tomllib.loads("\n".join(lines)), "calibration C.toml")
    assert str(caught.value).startswith("calibration C.toml: got ")
