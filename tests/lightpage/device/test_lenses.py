"""Lenses: a real one's path, and prescriptions against known figures, closed forms and themselves turned round."""

import math

import numpy as np
import pytest

from lightpage.device.lens_path import SeidelTerms
from lightpage.device.lenses import LENSES, LensPrescription, Surface
from lightpage.device.profile import load_profile, parse_profile
from lightpage.errors import ProfileError
from tests.lightpage.refused import refused
from tests.lightpage.small import THICK, small_profile

TERMS = SeidelTerms(1.1, -0.7, 0.5, 0.9, -1.3, 0.4, 0.3, -0.6, 0.8)


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
        beside = (x + dx, y + dy), (x - dx, y - dy)
        by_field = [TERMS.of_field(*at) + TERMS.of_both(*at, across, up) for at in beside]
        expected = (by_field[0] - by_field[1]) / (2 * step)
        np.testing.assert_allclose(TERMS.slope_on_field(x, y, across, up)[axis], expected, atol=1e-6)
    moved = TERMS.of_both(x + 0.3, y - 0.2, across, up) - path(across, up)
    np.testing.assert_allclose(TERMS.of_step(x, y, 0.3, -0.2, across, up), moved, atol=1e-12)


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


ACHROMAT = LENSES["AC508-080-A"]


def focal_distances_m(lens: LensPrescription) -> tuple[float, float, float]:
    return lens.effective_focal_m, lens.back_focal_m, lens.front_focal_m


def test_the_achromat_has_its_known_focal_distances() -> None:
    assert focal_distances_m(ACHROMAT) == pytest.approx((80.082e-3, 69.831e-3, 79.582e-3), abs=0.5e-6)


def test_a_thick_lens_obeys_the_lensmaker() -> None:
    first, second, thickness, index = 30e-3, -70e-3, 9e-3, 1.7
    lens = LensPrescription("thick", (Surface(first, thickness, index), Surface(second, 0, 1)), 20e-3)
    power = (index - 1) * (1 / first - 1 / second + (index - 1) * thickness / (index * first * second))
    shift = (index - 1) * thickness / (index * power)
    expected = (1 / power, (1 - shift * power / first) / power, (1 + shift * power / second) / power)
    assert focal_distances_m(lens) == pytest.approx(expected, rel=1e-12)


def test_reversed_it_has_its_focal_planes_swapped_and_keeps_its_conics() -> None:
    lens = LensPrescription("asphere", (Surface(30e-3, 9e-3, 1.7, conic=-0.6), Surface(-70e-3, 0, 1)), 20e-3)
    turned = lens.reversed()
    effective, back, front = focal_distances_m(lens)
    assert focal_distances_m(turned) == pytest.approx((effective, front, back), rel=1e-12)
    assert [surface.conic for surface in turned.surfaces] == [0, -0.6]
    assert ACHROMAT.reversed().reversed() == ACHROMAT


@pytest.mark.parametrize(
    ("surfaces", "got"),
    [
        ((), "no surface"),
        ((Surface(30e-3, 9e-3, 1.7),), "0.009 m of index 1.7"),
        ((Surface(30e-3, 9e-3, 1.7), Surface(-70e-3, 1e-3, 1)), "0.001 m of index 1"),
        ((Surface(math.inf, 9e-3, 1.7), Surface(math.inf, 0, 1)), "do not focus"),
    ],
)
def test_what_is_no_lens_in_air_is_refused(surfaces: tuple[Surface, ...], got: str) -> None:
    with refused(got=got):
        LensPrescription("odd", surfaces, 20e-3)
