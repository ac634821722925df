"""Claims about lens prescriptions: focal distances against known figures, closed forms and themselves turned round."""

from __future__ import annotations

import math

import pytest

from lightpage.device.lenses import LENSES, LensPrescription, Surface
from tests.lightpage.refused import refused

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


def test_a_flat_side_is_one_of_infinite_radius() -> None:
    lens = LensPrescription("flat in front", (Surface(math.inf, 4e-3, 1.5), Surface(-25e-3, 0, 1)), 20e-3)
    assert focal_distances_m(lens) == pytest.approx((50e-3, 50e-3, 50e-3 - 4e-3 / 1.5), rel=1e-12)


def test_reversed_it_has_its_focal_planes_swapped() -> None:
    turned = ACHROMAT.reversed()
    assert [surface.radius_m for surface in turned.surfaces] == [247.2e-3, 46.4e-3, -54.9e-3]
    assert [surface.index for surface in turned.surfaces] == [1.815674, 1.674748, 1]
    assert [surface.thickness_m for surface in turned.surfaces] == [2e-3, 16e-3, 0]
    effective, back, front = focal_distances_m(ACHROMAT)
    assert focal_distances_m(turned) == pytest.approx((effective, front, back), rel=1e-12)
    assert turned.reversed() == ACHROMAT


def test_each_surface_keeps_its_conic_when_reversed() -> None:
    lens = LensPrescription("asphere", (Surface(30e-3, 9e-3, 1.7, conic=-0.6), Surface(-70e-3, 0, 1)), 20e-3)
    assert [surface.conic for surface in lens.reversed().surfaces] == [0, -0.6]


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
