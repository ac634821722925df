"""Information that a decoded page carries, and calibration of its confidences: decisions and rates.

A decoder's estimate of a symbol is a von Mises density of its phase, with mean phase `mu` (radians) and concentration
`kappa`. All figures are computed in float64. `levels` is M, where symbol s stands for the phase 2 pi s / M, or says
which phases stand for symbols.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e, logsumexp

from lightpage.errors import PageError
from lightpage.page.levels import Levels
from lightpage.von_mises import mean_resultant

Floats = NDArray[np.float64]

CONCENTRATION_CAP = 1e9
"""Beyond this the float64 difference kappa I1/I0 - log I0 loses digits; one symbol of 256 levels needs about 1e5."""

_WINDOW = 12

_ALIASING = 60.0

_WINDOWS = (6, _WINDOW, 48)
"""Levels to either side of the nearest of uneven ones: the fewest that are enough are summed up."""

_LEFT_OUT = 1e-12
"""Probability of all levels outside a window of uneven ones, beside the nearest level's."""

_CHUNK = 8192

_LEAST_WEIGHT = 1e-200
"""Least weight of all levels with the right bit, over the most probable level's: a smaller sum has lost digits."""


def own_information(mu: NDArray[np.floating], kappa: NDArray[np.floating], levels: int | Levels) -> Floats:
    """Bits that an estimate claims to know of a symbol: log2 M less the entropy of its posterior; shape as `mu`.

    Where kappa is far below M^2 this is kappa I1(kappa) / (I0(kappa) ln 2) - log2 I0(kappa), which is all that there is
    to know of a phase that may take any value; among few levels it is less. It is the model's own claim and bounds
    nothing; see `achievable_rate`.

    Raises:
        PageError: shapes differ, a phase that is not finite, a concentration that is negative or not a number.
    """
    m, phase, k = _checked_estimate(mu, kappa, levels)
    shape, phase, k = phase.shape, phase.ravel(), k.ravel()
    claimed = np.log2(m.count) - (_log_partition(phase, k, m) + k * _mean_away(phase, k, m)) / np.log(2)
    return np.asarray(claimed.reshape(shape))


def page_kilobytes(bits_per_symbol: float, data_symbols: int) -> float:
    """Return the capacity of a page with so many data symbols, kilobytes of 8000 bits."""
    return bits_per_symbol * data_symbols / 8000


def decide(mu: NDArray[np.floating], levels: int | Levels) -> NDArray[np.uint8]:
    """The level nearest to each phase `mu` (radians, any winding); same shape, uint8."""
    return Levels.of(levels).nearest(mu)


def log_posterior(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int | Levels
) -> Floats:
    """Natural log of the posterior probability of level `symbols` among M equally likely levels, same shape.

    log softmax_k(kappa cos(theta_k - mu)) at k = symbols, theta_k the phase of level k.

    Raises:
        PageError: shapes differ, a symbol outside 0..M-1, a phase or concentration that is not finite.
    """
    m, phase, k, s = checked(mu, kappa, symbols, levels)
    away = 2 * np.sin(0.5 * (m.phases[s] - phase)) ** 2
    return np.asarray(-k * away - _log_partition(phase.ravel(), k.ravel(), m).reshape(phase.shape))


def decide_with_confidence(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], levels: int | Levels
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Nearest levels (uint8) and the posterior of each among the M levels (float32, 1/M..1); shapes as `mu`."""
    levels, phase, k = Levels.of(levels), np.asarray(mu), np.asarray(kappa)
    if phase.shape != k.shape:
        raise PageError("phase, concentration", (phase.shape, k.shape), "two equal shapes")
    symbols, confidence = np.empty(phase.shape, np.uint8), np.empty(phase.shape, np.float32)
    for rows in _chunks(phase.size):  # some at a time stay near the processor through all steps
        part = phase.ravel()[rows]
        decided = symbols.ravel()[rows] = decide(part, levels)
        posterior = np.exp(log_posterior(part, k.ravel()[rows], decided, levels))
        confidence.ravel()[rows] = np.clip(posterior, 1 / levels.count, 1)
    return symbols, confidence


def achievable_rate(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int | Levels
) -> Floats:
    """Contribution of each symbol to the AIR, bits: log2 M + log2 of the true level's posterior. The mean is the AIR.

    Its mean over held-out symbols is a lower bound on what a code can carry (mismatched decoding); it can be negative.
    """
    return np.asarray(
        np.log2(Levels.of(levels).count) + log_posterior(mu, kappa, symbols, levels) / np.log(2), np.float64
    )


def gray_rate(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int | Levels
) -> Floats:
    """Contribution of each symbol to the GMI of Gray-labelled bits (bit-metric decoding at scale 1), bits, 1-D.

    Sum over the log2 M bits of 1 + log2 posterior of the true bit.

    Raises:
        PageError: as `log_posterior`, or M is no power of two and has no Gray labels.
    """
    m, phase, k, s = checked(mu, kappa, symbols, levels)
    if not m.carry_bits:
        raise PageError("levels of a Gray-labelled page", m.count, "a power of two")
    bits = m.count.bit_length() - 1
    labels = np.arange(m.count) ^ (np.arange(m.count) >> 1)
    ones = labels[:, None] >> np.arange(bits) & 1
    total = np.full(phase.size, float(bits))
    for rows in _chunks(phase.size):
        logits = _logits(phase.ravel()[rows], k.ravel()[rows], m)
        sent = ones[s.ravel()[rows]]
        weights = np.exp(logits - logits.max(axis=1, keepdims=True))
        one, zero = weights @ ones, weights @ (1 - ones)
        alike = np.where(sent, one, zero)
        vanished = alike < _LEAST_WEIGHT
        log_share = np.log(np.where(vanished, 1.0, alike) / (one + zero))
        if vanished.any():  # too improbable for a plain sum
            symbol, bit = np.nonzero(vanished)
            same = sent[symbol, bit, None] == ones[:, bit].T
            of_same = logsumexp(np.where(same, logits[symbol], -np.inf), axis=1)
            log_share[vanished] = of_same - logsumexp(logits[symbol], axis=1)
        total[rows] += log_share.sum(axis=1) / np.log(2)
    return total


def _log_partition(phase: Floats, kappa: Floats, levels: Levels) -> Floats:
    """log Z, Z = sum_k exp(kappa (cos(theta_k - mu) - 1)), without M terms a symbol; within 1e-9 of the plain sum.

    Z of even levels is M (I0 + 2 sum_n I_nM cos(n M mu)) exp(-kappa): for kappa << M^2 only I0 counts. For a larger
    kappa, and of uneven levels, only the levels near mu count.
    """
    found = np.empty_like(kappa)
    for chosen, neighbours in _parts(phase, kappa, levels):
        if neighbours is None:
            found[chosen] = np.log(levels.count * i0e(kappa[chosen]))
            continue
        windows = _windows(phase[chosen], kappa[chosen], levels, neighbours)
        totals = [sum(weight for weight, _ in window) for window in windows]
        if totals:
            found[chosen] = np.log(np.concatenate(totals)) - kappa[chosen] * _closest(phase[chosen], levels)
    return found


def _mean_away(phase: Floats, kappa: Floats, levels: Levels) -> Floats:
    """The posterior's mean of 1 - cos(theta_k - mu), by the same sums."""
    found = np.empty_like(kappa)
    for chosen, neighbours in _parts(phase, kappa, levels):
        if neighbours is None:
            found[chosen] = 1 - mean_resultant(kappa[chosen])
            continue
        means = []
        for window in _windows(phase[chosen], kappa[chosen], levels, neighbours):
            weights, further = zip(*((weight, weight * more) for weight, more in window), strict=True)
            means.append(sum(further) / sum(weights))
        if means:
            found[chosen] = np.concatenate(means) + _closest(phase[chosen], levels)
    return found


Neighbours = NDArray[np.int64]
"""Levels that are summed over, by how many places further on the circle than the nearest each is."""


def _parts(phase: Floats, kappa: Floats, levels: Levels) -> Iterator[tuple[NDArray[np.bool_], Neighbours | None]]:
    """Yield masks of symbols with the levels that they need beside their nearest; None for symbols that need none."""
    everything, left = np.arange(levels.count), np.ones(kappa.shape, bool)
    if levels.count > 2 * _WINDOW + 1:
        if levels.is_nominal:
            narrow = kappa > levels.count**2 / _ALIASING
            yield ~narrow, None
            yield narrow, np.arange(-_WINDOW, _WINDOW + 1)
            return
        places = levels.places(phase)
        for width in _WINDOWS:
            if 2 * width + 1 < levels.count:
                narrow = left & (kappa > _least_concentrations(levels, width)[places])
                if narrow.any():
                    yield narrow, np.arange(-width, width + 1)
                left &= ~narrow
    if left.any():
        yield left, everything


def _least_concentrations(levels: Levels, width: int) -> Floats:
    """Concentrations from which so many neighbours to either side of each level on the circle are enough, [M]."""
    below, above = np.abs(levels.gaps(np.array([-1, 1]))) / 2
    far_below, far_above = np.abs(levels.gaps(np.array([-width - 1, width + 1])))
    nearest, next_one = np.maximum(below, above), np.minimum(far_below - below, far_above - above)
    gained = np.cos(nearest) - np.cos(np.minimum(next_one, np.pi))
    enough = np.log(levels.count / _LEFT_OUT) / np.maximum(gained, 1e-300)
    return np.asarray(np.where(gained > 0, enough, np.inf))


def _closest(phase: Floats, levels: Levels) -> Floats:
    """1 - cos of the distance to the nearest level."""
    return np.asarray(2 * np.sin(0.5 * (levels.nearest_phases(phase) - phase)) ** 2)


def _windows(
    phase: Floats, kappa: Floats, levels: Levels, neighbours: Neighbours
) -> Iterator[Iterator[tuple[Floats, Floats]]]:
    """Yield, for some symbols at a time, an iterator over the levels near mu, one level after the other.

    A level is a pair: its probability over the nearest level's, and its 1 - cos(theta_k - mu) less the nearest level's.
    """
    angles = neighbours * (2 * np.pi / levels.count) if levels.is_nominal else levels.gaps(neighbours)
    sines, versines = np.sin(angles), 2 * np.sin(0.5 * angles) ** 2

    def window(k: Floats, mu: Floats) -> Iterator[tuple[Floats, Floats]]:
        at, nearest = levels.around(mu)
        beside = nearest - mu
        cos, sin = np.cos(beside), np.sin(beside)
        for sine, versine in zip(sines, versines, strict=True):
            more = sin * sine[at] + cos * versine[at]
            yield np.exp(-k * more), more

    for rows in _chunks(kappa.size):
        yield window(kappa[rows], phase[rows])


def _logits(phase: Floats, kappa: Floats, levels: Levels) -> Floats:
    return np.asarray(kappa[:, None] * (np.cos(levels.phases[None, :] - phase[:, None]) - 1))


def _chunks(size: int) -> Iterator[slice]:
    return (slice(start, start + _CHUNK) for start in range(0, size, _CHUNK))


def _concentration(kappa: NDArray[np.floating]) -> Floats:
    k = np.atleast_1d(np.asarray(kappa, np.float64))
    if not (k >= 0).all():
        raise PageError("concentration", "a negative value or NaN", "numbers of at least 0")
    return np.minimum(k, CONCENTRATION_CAP)


def checked(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int | Levels
) -> tuple[Levels, Floats, Floats, NDArray[np.int64]]:
    """The levels, and the other arguments as flat arrays of one type each.

    Raises:
        PageError: see `log_posterior`.
    """
    levels, phase, k = _checked_estimate(mu, kappa, levels)
    s = np.atleast_1d(np.asarray(symbols))
    if phase.shape != s.shape:
        raise PageError("phase, symbols", (phase.shape, s.shape), "two equal shapes")
    if s.size and (int(s.min()) < 0 or int(s.max()) >= levels.count):
        raise PageError("symbols", f"{s.min()}..{s.max()}", f"0..{levels.count - 1}")
    return levels, phase, k, s.astype(np.int64)


def _checked_estimate(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], levels: int | Levels
) -> tuple[Levels, Floats, Floats]:
    levels = Levels.of(levels)
    phase, k = np.atleast_1d(np.asarray(mu, np.float64)), _concentration(kappa)
    if phase.shape != k.shape:
        raise PageError("phase, concentration", (phase.shape, k.shape), "two equal shapes")
    if not np.isfinite(phase).all():
        raise PageError("decoded phase", "NaN or infinity", "finite radians")
    return levels, phase, k
