"""Levels may stand for any phases; what a modulator makes of them says for which."""

from collections.abc import Callable

import numpy as np
import pytest

from lightpage.device.profile import load_profile
from lightpage.device.state import SlmDefects
from lightpage.errors import PageError
from lightpage.page.crosstalk import of_decoded_neighbours
from lightpage.page.levels import Levels
from lightpage.page.modulation import NOMINAL, Modulation
from lightpage.page.symbols import symbol_phases
from lightpage.simulator.true_optics import modulated, true_modulation
from tests.lightpage.refused import refused
from tests.lightpage.uneven import UNEVEN, overlapping, uneven

ALL, BENCH = Levels(256).phases, load_profile("bench")


@pytest.mark.parametrize("levels_of", [Levels, uneven, overlapping])
@pytest.mark.parametrize("count", [2, 3, 16, 256])
def test_the_nearest_level_is_found_whatever_the_winding(levels_of: Callable[[int], Levels], count: int) -> None:
    levels, mu = levels_of(count), np.random.default_rng(count).uniform(-20, 20, (20, 30))
    away = np.abs(np.angle(np.exp(1j * (levels.phases - mu[..., None]))))
    found = levels.nearest(mu)
    assert found.dtype == np.uint8
    of_found = np.take_along_axis(away, found[..., None].astype(int), -1)[..., 0]
    np.testing.assert_allclose(of_found, away.min(axis=-1), atol=1e-12)
    np.testing.assert_allclose(np.abs(levels.nearest_phases(mu) - mu), of_found, atol=1e-12)
    others = np.sort(np.abs(np.angle(np.exp(1j * (levels.phases - levels.phases[found][..., None])))), -1)[..., 1]
    np.testing.assert_allclose(np.broadcast_to(levels.half_way(mu), mu.shape), others / 2, atol=1e-12)


def test_every_eighth_of_uneven_levels_keeps_its_phase() -> None:
    assert uneven(64).every(8) == Levels(8, tuple(uneven(64).phases[::8]))
    assert Levels(64).every(8).is_nominal
    assert np.array_equal(Levels(64).every(8, 1).phases, Levels(64).phases[1::8])


def test_wrong_phases_are_refused() -> None:
    for phases in ((0.0,), (0.0, np.nan)):
        with refused("phases of levels", kind=PageError):
            Levels(2, phases)
    with refused("levels", kind=PageError):
        Levels(1)


def test_nominally_a_level_is_its_phase_to_the_last_bit() -> None:
    assert NOMINAL.page_levels(16) == Levels(16)
    assert np.array_equal(NOMINAL.light(ALL), np.exp(1j * ALL))
    assert np.array_equal(NOMINAL.phase(ALL), symbol_phases(np.arange(256), 256))


def test_the_phase_of_a_level_is_that_of_its_light() -> None:
    np.testing.assert_allclose(np.exp(1j * UNEVEN.phase(ALL)), np.exp(1j * np.angle(UNEVEN.light(ALL))), atol=1e-12)
    assert np.abs(UNEVEN.phase(ALL) - ALL).max() < 1
    assert np.array_equal(uneven(16).phases, uneven(256).phases[::16])


@pytest.mark.parametrize(
    "defects",
    [
        {"stroke_relative_error": -0.1, "level_sine_rad": 0.3, "level_cosine_rad": -0.2, "level_sine_twice_rad": 0.05},
        {"unmodulated_relative": 0.2, "unmodulated_phase_rad": 1.0},
        {"level_amplitude_relative": 0.2},
    ],
)
def test_few_coefficients_tell_what_a_real_modulator_makes_of_its_levels(defects: dict[str, float]) -> None:
    slm = SlmDefects(**defects)  # type: ignore[arg-type]
    off = modulated(slm, ALL) / true_modulation(slm, BENCH).light(ALL)
    # but for a factor, which is illumination and piston, what a fifth of unmodulated light leaves of the next harmonics
    assert np.abs(off / off.mean() - 1).max() < 1.5e-3
    assert true_modulation(SlmDefects(), BENCH) == NOMINAL


def test_what_crosstalk_adds_is_seen_in_a_decoded_page() -> None:
    modulation = Modulation((*NOMINAL.coefficients[:-2], 0.01, 0.004))
    written = np.random.default_rng(0).uniform(0, 2 * np.pi, (20, 30))
    light, levels = modulation.page_light(written), modulation.page_levels(256)
    added = np.angle(light * np.exp(-1j * written))
    beside = written[4, [2, 4]].sum() - 2 * np.pi, written[[3, 5], 3].sum() - 2 * np.pi
    assert added[4, 3] == pytest.approx(0.01 * beside[0] + 0.004 * beside[1])
    np.testing.assert_allclose(np.abs(light), 1, atol=1e-12)
    p = 1e4 * np.stack([light.real, light.imag])
    off = of_decoded_neighbours(p, levels.crosstalk) - added
    assert np.sqrt(np.mean(off[1:-1, 1:-1] ** 2)) < 0.15 * np.std(added)
    assert np.abs(of_decoded_neighbours(1e-8 * p, levels.crosstalk)).max() < 1e-5
    assert not of_decoded_neighbours(p, Levels(256).crosstalk).any()
