"""Bits on phases: labels of levels, log-likelihood ratios of their bits from a von Mises posterior, coset decisions.

Level s of M = 2^m is split: c = s mod 2^b tells its coset, and gets the b label bits c ^ (c >> 1), a Gray code that is
cyclic; s >> b is its number within the coset, m - b bits that are decided once the coset is known, when the nearest
other candidate is 2^b levels away. b = m is plain Gray-labelled coded modulation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.compiled.choice import compiled
from lightpage.codec.ldpc.decoder import MOST_LLR
from lightpage.codec.likelihood.neighbours import searches_of, table_of
from lightpage.codec.likelihood.ratios import MOST_PHASE, ratios
from lightpage.errors import PageError
from lightpage.page.levels import Levels, check_levels

Real = NDArray[np.float64]

_MOST_CONCENTRATION = 1e30
"""More says no more."""


def level_bits(levels: int) -> int:
    """m of M = 2^m levels.

    Raises:
        PageError: no power of two from 2 to 256.
    """
    check_levels(levels)
    if levels & (levels - 1):
        raise PageError("levels that carry bits", levels, "a power of two from 2 to 256")
    return levels.bit_length() - 1


def _check_label(levels: int, label_bits: int) -> None:
    if not 1 <= label_bits <= level_bits(levels):
        raise PageError(f"label bits of {levels} levels", label_bits, f"1 to {level_bits(levels)}")


def labels(label_bits: int) -> NDArray[np.uint8]:
    """Label of each coset number 0 .. 2^b - 1, uint8; its bit 0 is the first."""
    number = np.arange(1 << label_bits)
    return np.asarray(number ^ (number >> 1), np.uint8)


def bit_llrs(
    phase: NDArray[np.floating],
    concentration: NDArray[np.floating],
    levels: int | Levels,
    label_bits: int | None = None,
    threads: int = 1,
) -> NDArray[np.float32]:
    """Log-likelihood ratios ln P(0) / P(1) of the label bits of symbols whose levels are equally likely.

    The posterior of a level at theta is proportional to exp(kappa cos(theta - mu)); those of all levels whose label has
    the bit are added up. Levels far from the phase are left out where what they weigh changes nothing.

    Args:
        phase: decoded phases mu, radians, any shape; piston removed.
        concentration: kappa, the same shape.
        levels: M, a power of two, or uneven levels of that number.
        label_bits: b, 1 to log2 M; all bits, in Gray code, if left out.
        threads: number of threads that share the work where it is compiled.

    Returns:
        float32, the shape of `phase` and b; -40 to 40.

    Raises:
        PageError: shapes differ, a value that is not finite, a negative concentration, levels that carry no bits.
    """
    levels = Levels.of(levels)
    bits = level_bits(levels.count) if label_bits is None else label_bits
    _check_label(levels.count, bits)
    mu, kappa = np.asarray(phase, np.float64).ravel(), np.asarray(concentration, np.float64).ravel()
    if np.shape(phase) != np.shape(concentration):
        raise PageError("phase, concentration", (np.shape(phase), np.shape(concentration)), "two equal shapes")
    table = table_of(levels, bits)
    return ratios(*_checked(mu, kappa), table, MOST_LLR, threads).reshape(*np.shape(phase), bits)


def _checked(mu: Real, kappa: Real) -> tuple[Real, Real]:
    """Phases and concentrations, contiguous and not too large to be counted with.

    Raises:
        PageError: a value that is not finite, a negative concentration.
    """
    mu, kappa, native = np.ascontiguousarray(mu), np.ascontiguousarray(kappa), compiled()
    if native is not None and native.look(mu, kappa, _MOST_CONCENTRATION) == 0:
        return mu, kappa
    if not (np.isfinite(mu).all() and np.isfinite(kappa).all() and (kappa >= 0).all()):
        raise PageError("phase, concentration", "NaN, infinity or a negative concentration", "finite numbers")
    return _bounded(mu), np.minimum(kappa, _MOST_CONCENTRATION)


def to_levels(label: NDArray[np.uint8], upper: NDArray[np.integer], levels: int) -> NDArray[np.uint8]:
    """Levels of label bits and upper bits.

    Args:
        label: bits of each symbol, [symbols, b].
        upper: number of each within its coset, [symbols].
        levels: M, a power of two.
    """
    bits = label.shape[1]
    _check_label(levels, bits)
    number = np.argsort(labels(bits))[label @ (1 << np.arange(bits))]
    return np.asarray(number + (upper.astype(np.int64) << bits), np.uint8)


def decide_in_coset(phase: NDArray[np.floating], label: NDArray[np.uint8], levels: int | Levels) -> NDArray[np.int64]:
    """Number within its coset of the level that lies nearest to each phase, its label being known.

    Args:
        phase: decoded phases, radians, [symbols].
        label: bits of each symbol, [symbols, b].
        levels: M, a power of two, or uneven levels of that number.
    """
    levels, bits = Levels.of(levels), label.shape[1]
    _check_label(levels.count, bits)
    mu, number = _bounded(np.asarray(phase, np.float64)), np.argsort(labels(bits))[label @ (1 << np.arange(bits))]
    if levels.is_nominal:
        step = 2 * np.pi / levels.count
        nearest = np.rint((mu - number * step) / (step * (1 << bits))).astype(np.int64)
        return np.asarray(nearest % (levels.count >> bits))
    found = np.zeros(mu.shape, np.int64)
    if levels.count >> bits > 1:
        for coset in range(1 << bits):
            found[number == coset] = levels.every(1 << bits, coset).nearest(mu[number == coset])
    return found


def upper_bits(phase: Real, label: NDArray[np.uint8], levels: Levels) -> NDArray[np.uint8]:
    """Numbers within cosets as `decide_in_coset` finds them, bit by bit, the highest first: uint8 [symbols, m - b].

    Args:
        phase: decoded phases, radians, [symbols].
        label: bits of each symbol, [symbols, b].
        levels: M, a power of two, or uneven levels of that number.
    """
    label_bits, all_bits = label.shape[1], level_bits(levels.count)
    bits, native = np.empty((len(phase), all_bits - label_bits), np.uint8), compiled()
    compact = np.ascontiguousarray(label)
    if native is not None and bits.size:
        searches = None if levels.is_nominal else searches_of(levels, label_bits)
        if native.upper_bits(phase, compact, label_bits, all_bits, searches, bits):
            return bits
    number = decide_in_coset(phase, label, levels)
    return np.asarray(number[:, None] >> np.arange(bits.shape[1])[::-1] & 1, np.uint8)


def _bounded(phase: Real) -> Real:
    """Phases, contiguous, whole turns taken off where one is too large to be counted in turns."""
    phase = np.ascontiguousarray(phase)
    if phase.size and np.abs(phase).max() > MOST_PHASE:
        return np.fmod(phase, 2 * np.pi)
    return phase


def bit_information(llrs: NDArray[np.floating], bits: NDArray[np.uint8] | None = None) -> float:
    """Mean information of bits in their LLRs, 0 to 1 bit, negative where they mislead.

    Where the true bits are known it is 1 - log2(1 + exp(-L)), L the ratio in favour of the truth: what a code can
    carry. Else it is what the ratios claim themselves: 1 less the entropy of the bit.

    Args:
        llrs: ln P(0) / P(1).
        bits: the true ones, the same shape.
    """
    ratio = np.asarray(llrs, np.float64)
    if bits is not None:
        return float(1 - np.mean(np.logaddexp(0, np.where(bits == 0, -ratio, ratio))) / np.log(2))
    size = np.abs(ratio)
    wrong = 1 / (1 + np.exp(size))
    entropy = wrong * np.logaddexp(0, size) + (1 - wrong) * np.logaddexp(0, -size)
    return float(1 - np.mean(entropy) / np.log(2))
