"""A real lens's path: its derivatives, its mirror image, and how a profile states it."""

from __future__ import annotations

import numpy as np
import pytest

from lightpage.calibration.document import parse_calibration
from lightpage.calibration.parameters import NAMES
from lightpage.device.lens_path import SeidelTerms
from lightpage.device.profile import load_profile, parse_profile
from lightpage.errors import ProfileError
from tests.lightpage.refused import refused
from tests.lightpage.small import THICK, small_profile

TERMS = SeidelTerms(1.1, -0.7, 0.5, 0.9, -1.3, 0.4)


def test_slope_and_bend_are_the_derivatives() -> None:
    x, y, across, up = np.random.default_rng(0).uniform(-1, 1, (4, 50))
    step = 1e-4

    def path(across: np.ndarray, up: np.ndarray) -> np.ndarray:
        return np.asarray(TERMS.of_both(x, y, across, up))

    for axis, (dx, dy) in enumerate(((step, 0.0), (0.0, step))):
        plus, minus = path(across + dx, up + dy), path(across - dx, up - dy)
        np.testing.assert_allclose(TERMS.slope(x, y, across, up)[axis], (plus - minus) / (2 * step), atol=1e-6)
        bend = (plus - 2 * path(across, up) + minus) / step**2
        np.testing.assert_allclose(TERMS.bend(x, y, across, up)[axis], bend, atol=1e-5)
        by_field = [
            TERMS.of_field(x + side * dx, y + side * dy) + TERMS.of_both(x + side * dx, y + side * dy, across, up)
            for side in (1, -1)
        ]
        expected = (by_field[0] - by_field[1]) / (2 * step)
        np.testing.assert_allclose(TERMS.slope_on_field(x, y, across, up)[axis], expected, atol=1e-6)


def test_the_mirror_image_sends_the_same_path_from_the_point_opposite() -> None:
    x, y, across, up = np.random.default_rng(1).uniform(-1, 1, (4, 50))
    mirrored = TERMS.mirrored()
    # seen from the camera, whose coordinates are turned by half a turn, and conjugate
    np.testing.assert_allclose(-mirrored.of_both(x, y, across, up), TERMS.of_both(-x, -y, across, up), atol=1e-12)
    np.testing.assert_allclose(-mirrored.of_field(x, y), TERMS.of_field(-x, -y), atol=1e-12)


def test_a_profile_keeps_it_through_toml_and_ideal_lenses_go_without() -> None:
    thick = small_profile().model_copy(update={"lens_path": THICK})
    assert parse_profile(thick.to_toml()) == thick
    assert not thick.ideal_lenses
    assert "lens_path" not in small_profile().to_toml()
    with refused(got="lens_path.coma_rad", kind=ProfileError):
        parse_profile(thick.to_toml().replace("coma_rad = -1.4", "coma_rad = -4000.0"))


def test_the_same_lenses_are_stated_for_the_corner_of_a_page_cut_for_larger_symbols() -> None:
    paper = load_profile("paper")
    cut = paper.with_symbols_of(64)
    assert cut.corner_m < 0.98 * paper.corner_m
    np.testing.assert_allclose(cut.seidel_terms(), paper.seidel_terms(), rtol=1e-12)


def test_a_calibration_from_before_it_took_lenses_for_ideal(calibration_text: str) -> None:
    old = "\n".join(line for line in calibration_text.splitlines() if not line.startswith("lens_path_relative"))
    calibration = parse_calibration(old)
    assert calibration.parameters["lens_path_relative"] == -1
    assert calibration.deviations["lens_path_relative"] == 0
    assert small_profile().seidel_terms(1 + calibration.vector[NAMES.index("lens_path_relative")]) == SeidelTerms(
        *[0.0] * 6
    )


@pytest.fixture
def calibration_text() -> str:
    zeros = "\n".join(f"{name} = 0.0" for name in NAMES)
    return (
        'schema_version = 1\nprofile_name = "small"\nturn_rad = 1.57\ncoherence_before = 0.1\ncoherence_after = 0.5\n'
        f"cost = 1.0\nsignificant = 0.5\npages_used = 1\ncalibrated_pages = ['{'0' * 64}']\n\n"
        f"[parameters]\n{zeros}\n\n[deviations]\n{zeros}\n"
    )
