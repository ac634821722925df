"""Claims about rates and confidence, against numerical integration and draws from von Mises densities."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp, softmax
from scipy.stats import entropy

from lightpage import von_mises
from lightpage.errors import PageError
from lightpage.metrics import information, measures, reliability
from lightpage.page.levels import Levels
from tests.lightpage.refused import refused
from tests.lightpage.uneven import overlapping, uneven


def drawn_page(levels: int | Levels, kappa: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """True symbols and decoded phases whose errors do follow the concentrations."""
    rng, levels = np.random.default_rng(seed), Levels.of(levels)
    symbols = rng.integers(levels.count, size=kappa.shape)
    return symbols, levels.phases[symbols] + rng.vonmises(0.0, kappa)


SOME_LEVELS = [
    *map(Levels, (2, 3, 16, 25, 26, 256)),
    *(some(count) for some in (uneven, overlapping) for count in (2, 25, 26, 97, 256)),
]
"""Few, all of which are summed up, and many, where a window is enough or not."""


def logits_of(mu: np.ndarray, kappa: np.ndarray, levels: Levels) -> np.ndarray:
    return np.asarray(kappa[:, None] * (np.cos(levels.phases - mu[:, None]) - 1))


@pytest.mark.parametrize("levels", SOME_LEVELS)
def test_own_information_is_what_the_posterior_leaves_unknown(levels: Levels) -> None:
    rng = np.random.default_rng(levels.count)
    kappa, mu = 10 ** rng.uniform(-3, 6, 400), rng.uniform(-20, 20, 400)
    logits = logits_of(mu, kappa, levels)
    expected = np.log2(levels.count) - entropy(softmax(logits, axis=1), base=2, axis=1)
    np.testing.assert_allclose(information.own_information(mu, kappa, levels), expected, atol=1e-8)


@pytest.mark.parametrize("levels", SOME_LEVELS)
def test_posterior_equals_the_plain_softmax(levels: Levels) -> None:
    rng = np.random.default_rng(levels.count)
    kappa, mu = 10 ** rng.uniform(-3, 6, 400), rng.uniform(-20, 20, 400)
    symbols = np.where(rng.random(400) < 0.5, information.decide(mu, levels), rng.integers(levels.count, size=400))
    logits = logits_of(mu, kappa, levels)
    expected = logits[np.arange(400), symbols] - logsumexp(logits, axis=1)
    # float64 knows a phase of 20 rad to 4e-15 and kappa multiplies that, so part of the allowance grows with kappa.
    difference = np.abs(information.log_posterior(mu, kappa, symbols, levels) - expected)
    assert (difference <= 1e-9 + 1e-13 * kappa).all()


def test_overconfident_estimates_claim_more_than_they_achieve() -> None:
    kappa = np.full(50_000, 8.0)
    symbols, mu = drawn_page(16, kappa, 3)
    calibrated = measures.measure(mu, kappa, symbols, 16)
    overconfident = measures.measure(mu, 6 * kappa, symbols, 16)
    assert overconfident.air_bits_per_symbol < calibrated.air_bits_per_symbol - 0.3
    assert overconfident.over_claim_bits_per_symbol > calibrated.over_claim_bits_per_symbol + 1
    assert overconfident.ece > 0.1 > 0.01 > calibrated.ece


@pytest.mark.parametrize("levels", [Levels(8), uneven(8)])
def test_gray_rate_is_a_brute_force_bit_posterior_and_never_above_air(levels: Levels) -> None:
    kappa = np.full(3000, 12.0)
    symbols, mu = drawn_page(levels, kappa, 4)
    weight = np.exp(logits_of(mu, kappa, levels))
    weight /= weight.sum(1, keepdims=True)
    labels = np.array([0b000, 0b001, 0b011, 0b010, 0b110, 0b111, 0b101, 0b100])
    expected = np.zeros(3000)
    for bit in range(3):
        alike = (labels >> bit & 1)[None, :] == (labels[symbols] >> bit & 1)[:, None]
        expected += 1 + np.log2((weight * alike).sum(1))
    got = information.gray_rate(mu, kappa, symbols, levels)
    np.testing.assert_allclose(got, expected, atol=1e-9)
    assert got.mean() <= information.achievable_rate(mu, kappa, symbols, levels).mean()


@pytest.mark.parametrize("levels", [overlapping(16), uneven(256)])
def test_figures_of_uneven_levels_are_calibrated_where_those_of_even_ones_are_not(levels: Levels) -> None:
    kappa = np.full(20_000, 300.0)
    symbols, mu = drawn_page(levels, kappa, 5)
    known, even = (measures.measure(mu, kappa, symbols, each) for each in (levels, levels.count))
    assert known.ece < 0.01 < 0.1 < even.ece
    assert abs(known.over_claim_bits_per_symbol) < 0.03
    assert even.over_claim_bits_per_symbol > 1
    assert known.levels == even.levels == levels.count


def test_gray_rate_of_a_bit_that_is_all_but_impossible_is_a_number() -> None:
    """A symbol opposite the decided one: of its first bit, levels a quarter of a turn away are the least improbable."""
    kappa, symbols = np.array([3e4]), np.array([2])
    got = information.gray_rate(np.zeros(1), kappa, symbols, 4)
    # 0 is labelled 00 and 2 is 11: each bit's best level with the right value is a quarter of a turn away
    assert got[0] == pytest.approx(2 - 2 * kappa[0] / np.log(2), rel=1e-12)


def test_gray_labels_need_a_power_of_two_and_the_page_measure_says_none_without() -> None:
    kappa = np.full(100, 12.0)
    symbols, mu = drawn_page(6, kappa, 5)
    with refused(kind=PageError, wanted="power of two"):
        information.gray_rate(mu, kappa, symbols, 6)
    assert measures.measure(mu, kappa, symbols, 6).gmi_bits_per_symbol is None


def test_ece_is_the_gap_between_claim_and_accuracy() -> None:
    confidence = np.full(1000, 0.9)
    assert reliability.expected_calibration_error(confidence, np.arange(1000) < 600) == pytest.approx(0.3)
    two_bins = np.repeat([0.95, 0.55], 500)
    correct = np.concatenate([np.arange(500) < 450, np.arange(500) < 300])
    assert reliability.expected_calibration_error(two_bins, correct) == pytest.approx(0.05)


def test_bins_of_confidence_hold_every_symbol_once_with_its_claim_and_outcome() -> None:
    confidence = np.repeat([0.95, 0.55, 1.0, 0.25], [500, 400, 100, 1])
    bins = reliability.reliability(confidence, np.arange(1001) % 4 > 0, bins=10)
    counted = [(round(b.low, 9), round(b.high, 9), b.count) for b in bins]
    assert counted == [(0.2, 0.3, 1), (0.5, 0.6, 400), (0.9, 1.0, 600)]
    assert [b.confidence for b in bins] == pytest.approx([0.25, 0.55, (500 * 0.95 + 100) / 600])
    assert [b.accuracy for b in bins] == [0, 0.75, 0.75]
    with refused("confidences", kind=PageError):
        reliability.reliability(np.empty(0), np.empty(0, bool))


def test_maps_average_to_the_figures_of_the_page() -> None:
    data = np.random.default_rng(8).random((5, 7)) > 0.2
    kappa = np.random.default_rng(9).gamma(2.0, 20.0, (3, np.count_nonzero(data)))
    symbols, mu = drawn_page(64, kappa, 10)
    maps, figures = measures.symbol_maps(mu, kappa, symbols, 64, data), measures.measure(mu, kappa, symbols, 64)
    assert np.nanmean(maps.air) == pytest.approx(figures.air_bits_per_symbol)
    assert np.nanmean(maps.own_mi) == pytest.approx(figures.own_mi_bits_per_symbol)
    for page in (maps.air, maps.own_mi, maps.error_rad):
        assert np.array_equal(np.isfinite(page), data)
    # each symbol's errors stay at its own place, whatever the winding
    off = symbols * (2 * np.pi / 64) + np.arange(kappa.shape[1]) * 0.01 * np.array([1, -1, 1])[:, None] + 4 * np.pi
    assert measures.symbol_maps(off, kappa, symbols, 64, data).error_rad[data] == pytest.approx(
        np.arange(kappa.shape[1]) * 0.01
    )
    with pytest.raises(PageError):
        measures.symbol_maps(mu[:, 1:], kappa[:, 1:], symbols[:, 1:], 64, data)


@pytest.mark.parametrize(
    ("mu", "kappa", "symbols", "levels", "named"),
    [
        (np.zeros(2), np.ones(2), np.zeros(2, int), 1, "levels"),
        (np.zeros(2), np.ones(3), np.zeros(2, int), 4, "equal shapes"),
        (np.zeros(2), np.array([1, np.nan]), np.zeros(2, int), 4, "concentration"),
        (np.zeros(2), np.array([1, -1.0]), np.zeros(2, int), 4, "concentration"),
        (np.array([0, np.inf]), np.ones(2), np.zeros(2, int), 4, "phase"),
        (np.zeros(2), np.ones(2), np.array([0, 4]), 4, "symbols"),
    ],
)
def test_nonsense_is_named(mu: np.ndarray, kappa: np.ndarray, symbols: np.ndarray, levels: int, named: str) -> None:
    with pytest.raises(PageError) as caught:
        information.log_posterior(mu, kappa, symbols, levels)
    assert named in str(caught.value)


@pytest.mark.parametrize("kappa", [0.0, 0.3, 4.0, 60.0])
def test_promises_are_integrals_of_the_density(kappa: float) -> None:
    def weight(angle: float) -> float:
        return float(np.exp(kappa * (np.cos(angle) - 1)))

    total, _ = quad(weight, -np.pi, np.pi)
    cosine, _ = quad(lambda angle: weight(angle) * np.cos(angle), -np.pi, np.pi)
    told, _ = quad(lambda angle: weight(angle) / total * np.log(2 * np.pi * weight(angle) / total), -np.pi, np.pi)
    assert von_mises.mean_resultant(np.array([kappa]))[0] == pytest.approx(cosine / total, abs=1e-9)
    assert von_mises.information(np.array([kappa]))[0] == pytest.approx(told, abs=1e-9)


def test_a_narrow_density_tells_as_a_normal_one_does() -> None:
    expected = np.log(2 * np.pi) - np.log(2 * np.pi * np.e / 5000) / 2
    assert von_mises.information(np.array([5000.0]))[0] == pytest.approx(expected, abs=1e-3)
