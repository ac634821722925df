"""Bits on phases: the ratios are those of the posterior, labels are Gray, levels and labels are inverse."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.special import logsumexp

from lightpage.codec.mapping import MOST_LLR, bit_information, bit_llrs, decide_in_coset, labels, level_bits, to_levels
from lightpage.errors import PageError
from lightpage.page.levels import Levels
from tests.lightpage.refused import refused
from tests.lightpage.uneven import overlapping, uneven

ALL_SPLITS = [(1 << bits, coded) for bits in range(1, 9) for coded in range(1, bits + 1)]


def label_of(levels: int, coded: int) -> np.ndarray:
    """Label bits of every level, [levels, b], by the specification."""
    number = np.arange(levels) % (1 << coded)
    return (number ^ number >> 1)[:, None] >> np.arange(coded) & 1


def brute_force(phase: np.ndarray, kappa: np.ndarray, levels: Levels, coded: int) -> np.ndarray:
    """ln P(0) / P(1) in double precision over all levels, [symbols, b], not clipped."""
    # kappa (cos - 1) by the half angle, which keeps the digits that a large kappa needs
    log_weight = -2 * kappa[:, None] * np.sin((phase[:, None] - levels.phases) / 2) ** 2
    ratios = [
        logsumexp(log_weight[:, bit == 0], axis=1) - logsumexp(log_weight[:, bit == 1], axis=1)
        for bit in label_of(levels.count, coded).T
    ]
    return np.stack(ratios, axis=-1)


@pytest.mark.parametrize("levels_of", [Levels, uneven, overlapping])
@pytest.mark.parametrize(("count", "coded"), ALL_SPLITS)
def test_ratios_are_those_of_the_posterior(count: int, coded: int, levels_of: Callable[[int], Levels]) -> None:
    rng, levels = np.random.default_rng([count, coded]), levels_of(count)
    phase = np.concatenate([rng.uniform(-12, 12, 400), 2 * np.pi / count * (np.arange(-count, count) + 0.5)])
    kappa = np.where(rng.random(phase.size) < 0.05, 0, 10 ** rng.uniform(-3, 6, phase.size))
    got = bit_llrs(phase, kappa, levels, coded)
    assert got.dtype == np.float32
    assert got.shape == (phase.size, coded)
    expected = np.clip(brute_force(phase, kappa, levels, coded), -MOST_LLR, MOST_LLR)
    # the exponents are at most 87 (where exp leaves float32), with 24 bits; the sums have at most 256 terms
    np.testing.assert_allclose(got, expected, rtol=0, atol=87 * 2.0**-23 + 256 * 2.0**-24)
    assert not got[kappa == 0].any()


def test_many_symbols_are_as_few() -> None:
    rng = np.random.default_rng(0)
    phase, kappa = rng.uniform(-4, 4, 5000), rng.uniform(0, 1e4, 5000)  # more than are taken at once
    whole = bit_llrs(phase, kappa, 256, 2)
    assert np.array_equal(whole[4000:], bit_llrs(phase[4000:], kappa[4000:], 256, 2))


@pytest.mark.parametrize("coded", range(1, 9))
def test_labels_are_a_cyclic_gray_code(coded: int) -> None:
    got = labels(coded)
    assert sorted(got) == list(range(1 << coded))
    assert [int(label).bit_count() for label in got ^ np.roll(got, 1)] == [1] * (1 << coded)


@pytest.mark.parametrize(("levels", "coded"), ALL_SPLITS)
def test_levels_and_their_labels_are_inverse(levels: int, coded: int) -> None:
    level = np.arange(levels)
    label, upper = label_of(levels, coded).astype(np.uint8), level >> coded
    assert np.array_equal(to_levels(label, upper, levels), level)
    rng = np.random.default_rng(0)
    # less than half of the distance between levels of a coset, whatever the number of turns
    off = rng.uniform(-0.499, 0.499, (20, levels)) * (1 << coded)
    turns = rng.integers(-3, 4, (20, levels))
    phases = 2 * np.pi * ((level + off) / levels + turns)
    for phase in phases:
        assert np.array_equal(decide_in_coset(phase, label, levels), upper)
    around = uneven(levels)
    for away in (0, 0.4 / levels, -0.4 / levels):  # less than half of the smallest distance
        assert np.array_equal(decide_in_coset(around.phases + away, label, around), upper)
    if coded < level_bits(levels):
        beyond = 2 * np.pi / levels * (level + 0.501 * (1 << coded))
        assert np.array_equal(decide_in_coset(beyond, label, levels), (upper + 1) % (levels >> coded))


class TestInformation:
    def test_limits(self) -> None:
        right = np.array([MOST_LLR, -MOST_LLR])
        bits = np.array([0, 1], np.uint8)
        assert bit_information(right, bits) == pytest.approx(1, abs=1e-15)
        assert bit_information(right) == pytest.approx(1, abs=1e-15)
        assert bit_information(np.zeros(5)) == bit_information(np.zeros(5), np.ones(5, np.uint8)) == 0
        # certain and wrong: log2(1 + e^40) bits less than what is right
        assert bit_information(right, 1 - bits) == pytest.approx(1 - MOST_LLR / np.log(2), rel=1e-12)

    @pytest.mark.parametrize("error", [0.001, 0.11, 0.3, 0.5])
    def test_a_binary_symmetric_channel_carries_one_less_its_entropy(self, error: float) -> None:
        size = np.log((1 - error) / error)
        capacity = 1 + error * np.log2(error) + (1 - error) * np.log2(1 - error)
        assert bit_information(np.array([size, -size])) == pytest.approx(capacity, abs=1e-12)
        wrong = round(1000 * error)
        bits = np.zeros(1000, np.uint8)
        ratios = np.where(np.arange(1000) < wrong, -size, size)
        assert bit_information(ratios, bits) == pytest.approx(capacity, abs=1e-12)
        assert bit_information(-ratios, bits + 1) == pytest.approx(capacity, abs=1e-12)


class TestRefusals:
    @pytest.mark.parametrize(("levels", "coded"), [(1, 1), (255, 1), (512, 1), (16, 0), (16, 5)])
    def test_levels_that_carry_no_whole_bits_and_label_bits_that_they_lack(self, levels: int, coded: int) -> None:
        with pytest.raises(PageError):
            bit_llrs(np.zeros(2), np.ones(2), levels, coded)

    @pytest.mark.parametrize(("phase", "kappa"), [(np.nan, 1), (0, np.nan), (np.inf, 1), (0, np.inf), (0, -1e-9)])
    def test_what_is_no_posterior(self, phase: float, kappa: float) -> None:
        with refused("phase, concentration", kind=PageError):
            bit_llrs(np.array([0.0, phase]), np.array([1.0, kappa]), 4)
        with refused("phase, concentration", ((3, 2), (2, 3)), PageError):
            bit_llrs(np.zeros((3, 2)), np.zeros((2, 3)), 4)
