"""The pilots give the piston, how far a decoder may be trusted, and whether a page may be given out."""

import numpy as np
import pytest

from lightpage.errors import PageError
from lightpage.metrics.information import achievable_rate, own_information
from lightpage.page.pilots import (
    Pilots,
    estimate_piston,
    estimate_trust,
    read_pilots,
    remove_piston,
    stroke_error,
    without_outliers,
)
from tests.lightpage.refused import refused
from tests.runtime import toy


def page_of(symbols: np.ndarray, levels: int, piston: float, kappa: float = 5.0) -> np.ndarray:
    phase = symbols * 2 * np.pi / levels + piston
    return kappa * np.stack([np.cos(phase), np.sin(phase)])


def test_piston_is_exact_without_noise() -> None:
    symbols = toy.symbols_of(8, 3)[0]
    piston = estimate_piston(page_of(symbols, 8, 1.234), Pilots.of_profile(toy.PROFILE, 8))
    assert piston.angle_rad == pytest.approx(1.234, abs=1e-12)
    assert piston.coherence == pytest.approx(1)


def test_pilots_that_say_nothing_show_in_the_coherence() -> None:
    rng = np.random.default_rng(1)
    pilots = Pilots.of_profile(toy.PROFILE, 8)
    p = page_of(rng.integers(8, size=toy.PAGE), 8, 0.3)
    count = np.count_nonzero(pilots.mask)
    assert estimate_piston(p, pilots).coherence < 3 / np.sqrt(count)
    assert estimate_piston(np.zeros((2, *toy.PAGE)), pilots).coherence == 0


def test_a_pilot_without_confidence_does_not_count() -> None:
    symbols = toy.symbols_of(8, 3)[0]
    pilots = Pilots.of_profile(toy.PROFILE, 8)
    p = page_of(symbols, 8, 0.5)
    wrong = np.argwhere(pilots.mask)[0]
    p[:, wrong[0], wrong[1]] = [1e-9, -1e-9]
    assert estimate_piston(p, pilots).angle_rad == pytest.approx(0.5, abs=1e-9)


def test_a_stroke_that_is_too_long_is_a_slope_over_the_pilots_phases() -> None:
    symbols = toy.symbols_of(16, 3)[0]
    phase = np.float32(1.01 * 2 * np.pi / 16 * symbols + 0.1)
    kappa, everywhere = np.full(toy.PAGE, 5.0), np.ones(toy.PAGE, bool)
    assert stroke_error(phase, kappa, Pilots.of_symbols(everywhere, symbols, 16)).relative == pytest.approx(
        0.01, abs=1e-6
    )
    assert np.isnan(stroke_error(phase, kappa, Pilots.of_symbols(everywhere, 0 * symbols + 5, 16)).relative)


def test_phase_stays_within_half_a_turn() -> None:
    phase = np.linspace(-np.pi, np.pi, 101, dtype=np.float32)
    for angle in (-3.0, 0.0, 3.0):
        turned = remove_piston(phase, angle)
        assert turned.dtype == np.float32
        assert np.abs(turned).max() <= np.float32(np.pi)
        np.testing.assert_allclose(np.exp(1j * turned), np.exp(1j * (phase - angle)), atol=1e-6)


def test_pilots_of_another_page_shape_are_refused() -> None:
    with refused("pilot positions", kind=PageError):
        estimate_piston(np.zeros((2, 3, 3)), Pilots.of_profile(toy.PROFILE, 8))
    with refused("pilot positions", kind=PageError):
        Pilots.of_symbols(np.ones((3, 3), bool), np.zeros(toy.PAGE, np.uint8), 8)
    with refused("pilots", kind=PageError):
        Pilots.of_symbols(np.zeros(toy.PAGE, bool), np.zeros(toy.PAGE, np.uint8), 8)


def noisy(kappa: float, claim: float, seed: int) -> tuple[np.ndarray, Pilots]:
    """p of a page of 16 levels whose errors have concentration `kappa` where `claim` is claimed."""
    rng = np.random.default_rng(seed)
    symbols = toy.symbols_of(16, seed)[0]
    mask = np.zeros(toy.PAGE, bool)
    mask.flat[rng.choice(mask.size, 54, replace=False)] = True
    phase = 2 * np.pi / 16 * symbols + rng.vonmises(0, kappa, toy.PAGE)
    return claim * np.stack([np.cos(phase), np.sin(phase)]), Pilots.of_symbols(mask, symbols, 16)


class TestTrust:
    @pytest.mark.parametrize(("kappa", "claim"), [(400, 400), (400, 4000), (40, 400), (4, 400)])
    def test_it_takes_an_over_claim_back(self, kappa: float, claim: float) -> None:
        found = []
        for seed in range(40):
            p, pilots = noisy(kappa, claim, seed)
            found.append(estimate_trust(p, pilots, estimate_piston(p, pilots).angle_rad))
        # 2 kappa (1 - cos error) is 1 on average for errors of a large concentration, less for others
        over = 1 if claim == kappa else claim / (kappa - 0.5 if kappa > 4 else kappa * 0.86)
        assert np.median(found) == pytest.approx(1 / over, rel=0.1)
        assert max(found) <= 1

    def test_chance_takes_little_from_right_claims(self) -> None:
        pages = [noisy(400, 400, seed) for seed in range(200)]
        trusts = [estimate_trust(p, pilots, estimate_piston(p, pilots).angle_rad) for p, pilots in pages]
        assert np.mean(trusts) > 0.96

    def test_the_trust_is_a_posterior_mean(self) -> None:
        p, pilots = noisy(400, 600, 1)
        angle = estimate_piston(p, pilots).angle_rad
        errors = p[0][pilots.mask] + 1j * p[1][pilots.mask]
        errors *= np.exp(-1j * (angle + pilots.phases))
        missed = 2 * np.sum(np.abs(errors) - errors.real)
        factors = np.exp(np.linspace(-12, 0, 20_001))
        density = factors ** ((len(errors) - 1) / 2) * np.exp(missed / 2 * (1 - factors))
        over = 0.3 * np.trapezoid(density, np.log(factors))
        mean = 0.3 * np.trapezoid(density * factors, np.log(factors))
        assert estimate_trust(p, pilots, angle) == pytest.approx((1 + mean) / (1 + over), rel=1e-4)

    def test_one_pilot_tells_nothing(self) -> None:
        p, pilots = noisy(400, 400, 0)
        mask = np.zeros_like(pilots.mask)
        mask.flat[np.flatnonzero(pilots.mask)[0]] = True
        one = Pilots(mask, pilots.phases[:1])
        assert estimate_trust(p, one, estimate_piston(p, one).angle_rad) == 1

    @pytest.mark.parametrize(("kappa", "outliers", "off_rad"), [(100, 1, 1.5), (1000, 2, np.pi), (4000, 2, 1.5)])
    def test_few_dead_places_cost_nothing(self, kappa: float, outliers: int, off_rad: float) -> None:
        p, pilots = noisy(kappa, kappa, 0)
        phases = pilots.phases.copy()
        phases[:outliers] += off_rad
        broken = Pilots(pilots.mask, phases)
        left = without_outliers(p, broken)
        assert len(left.phases) == 54 - outliers
        whole, piston = estimate_piston(p, pilots), estimate_piston(p, left)
        assert piston.angle_rad == pytest.approx(whole.angle_rad, abs=0.2 / np.sqrt(kappa))
        before = estimate_trust(p, pilots, whole.angle_rad)
        assert estimate_trust(p, left, piston.angle_rad) == pytest.approx(before, abs=0.05)

    @pytest.mark.parametrize(("kappa", "claim"), [(400, 400), (4, 400)])
    def test_pilots_of_a_sound_page_all_count(self, kappa: float, claim: float) -> None:
        kept = [len(without_outliers(*noisy(kappa, claim, seed)).phases) for seed in range(40)]
        assert np.mean(kept) > 53.9

    @pytest.mark.parametrize(("wrong", "left"), [(2, 38), (3, 40)])
    def test_one_in_twenty_may_be_dead(self, wrong: int, left: int) -> None:
        p, pilots = noisy(4000, 4000, 0)
        mask, phases = pilots.mask.copy(), pilots.phases[:40].copy()
        mask[mask] = np.arange(54) < 40
        phases[:wrong] += np.pi
        assert len(without_outliers(p, Pilots(mask, phases)).phases) == left

    def test_a_device_that_changed_in_part_is_not_excused(self) -> None:
        p, pilots = noisy(400, 400, 0)
        phases = pilots.phases.copy()
        phases[:10] += 2.0
        changed = Pilots(pilots.mask, phases)
        assert without_outliers(p, changed) is changed
        left = without_outliers(p, Pilots(pilots.mask, np.roll(pilots.phases, 1)))
        assert estimate_trust(p, left, estimate_piston(p, left).angle_rad) < 0.01


class TestCheck:
    """A decoder's claims about its pilots are compared with their true phases."""

    def test_the_bits_are_those_of_the_metrics_at_levels_too_fine_to_matter(self) -> None:
        p, pilots = noisy(30, 30, 0)
        check = read_pilots(p, pilots).check
        phase, kappa = np.arctan2(p[1], p[0])[pilots.mask], np.hypot(*p)[pilots.mask]
        assert check.claimed_bits == pytest.approx(float(own_information(phase, kappa, 256).mean()), abs=1e-6)
        reading = read_pilots(p, pilots)
        symbols = np.rint(pilots.phases * 256 / (2 * np.pi)).astype(np.uint8)  # 16 levels lie on 256
        rate = achievable_rate(phase - reading.piston.angle_rad, reading.trust * kappa, symbols, 256)
        assert check.confirmed_bits == pytest.approx(float(rate.mean()), abs=1e-6)

    @pytest.mark.parametrize("kappa", [3, 30, 300, 3000])
    def test_true_claims_are_confirmed_and_no_recalibration_is_due(self, kappa: float) -> None:
        checks = [read_pilots(*noisy(kappa, kappa, seed)).check for seed in range(40)]
        assert all(check.confirmed for check in checks)
        assert np.mean([check.share for check in checks]) == pytest.approx(1, abs=0.05)
        if kappa >= 30:  # in dimmer light few pilots tell little
            assert all(check.sound and not check.recalibration_due for check in checks)

    def test_a_device_that_has_drifted_is_answered_and_a_recalibration_is_due(self) -> None:
        checks = [read_pilots(*noisy(30, 3000, seed)).check for seed in range(40)]
        assert all(check.confirmed and check.recalibration_due for check in checks)

    def test_claims_of_which_little_is_left_are_not_confirmed(self) -> None:
        checks = [read_pilots(*noisy(1.5, 3000, seed)).check for seed in range(40)]
        assert not any(check.confirmed for check in checks)

    @pytest.mark.parametrize("claim", [0.05, 1, 30, 3000])
    def test_noise_is_never_confirmed_whatever_it_claims(self, claim: float) -> None:
        checks = [read_pilots(*noisy(0, claim, seed)).check for seed in range(100)]
        assert not any(check.confirmed for check in checks)

    def test_a_page_that_claims_nothing_confirms_nothing(self) -> None:
        _, pilots = noisy(1, 1, 0)
        check = read_pilots(np.zeros((2, *toy.PAGE)), pilots).check
        assert check.claimed_bits == check.share == 0
        assert not check.confirmed
