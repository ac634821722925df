"""How much a decoded page carries and how honest its confidence is: decisions, rates, calibration of beliefs.

A decoder believes of every symbol that its phase follows a von Mises density with mean phase `mu` (radians) and
concentration `kappa`. All figures are computed in float64. `levels` is M: symbol s stands for the phase 2 pi s / M.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e, logsumexp

from lightpage.errors import PageError
from lightpage.page.symbols import check_levels
from lightpage.von_mises import mean_resultant

Floats = NDArray[np.float64]

CONCENTRATION_CAP = 1e9
"""Beyond this the float64 difference kappa I1/I0 - log I0 loses digits; one symbol of 256 levels needs about 1e5."""

ECE_BINS = 15
_WINDOW = 12
_ALIASING = 60.0
_CHUNK = 8192


def own_information(mu: NDArray[np.floating], kappa: NDArray[np.floating], levels: int) -> Floats:
    """Bits that a belief claims to know of a symbol: log2 M less the entropy of its posterior; shape as `mu`.

    Where kappa is far below M^2 this is kappa I1(kappa) / (I0(kappa) ln 2) - log2 I0(kappa), which is all that there is
    to know of a phase that may take any value; among few levels it is less. It is the model's own claim and bounds
    nothing; see `achievable_rate`.

    Raises:
        PageError: shapes differ, a phase that is not finite, a concentration that is negative or not a number.
    """
    m, phase, k = _checked_belief(mu, kappa, levels)
    log_partition, away = _partition(phase, k, m)
    return np.asarray(np.log2(m) - (log_partition + k * away) / np.log(2))


def page_kilobytes(bits_per_symbol: float, data_symbols: int) -> float:
    """What a page of so many data symbols carries, kilobytes of 8000 bits."""
    return bits_per_symbol * data_symbols / 8000


def decide(mu: NDArray[np.floating], levels: int) -> NDArray[np.uint8]:
    """The level nearest to each phase `mu` (radians, any winding); same shape, uint8."""
    check_levels(levels)
    return np.asarray(np.rint(np.asarray(mu, np.float64) * (levels / (2 * np.pi))) % levels, np.uint8)


def log_posterior(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int
) -> Floats:
    """Natural log of the posterior probability of level `symbols` among M equally likely levels, same shape.

    log softmax_k(kappa cos(theta_k - mu)) at k = symbols.

    Raises:
        PageError: shapes differ, a symbol outside 0..M-1, a phase or concentration that is not finite.
    """
    m, phase, k, s = _checked(mu, kappa, symbols, levels)
    error = s * (2 * np.pi / m) - phase
    return np.asarray(k * (np.cos(error) - 1) - _partition(phase, k, m)[0])


def decide_with_confidence(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], levels: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Nearest levels (uint8) and the posterior of each among the M levels (float32, 1/M..1); shapes as `mu`."""
    symbols = decide(mu, levels)
    confidence = np.exp(log_posterior(mu, kappa, symbols, levels))
    return symbols, np.clip(confidence, 1 / levels, 1).astype(np.float32)


def achievable_rate(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int
) -> Floats:
    """Contribution of each symbol to the AIR, bits: log2 M + log2 of the true level's posterior. The mean is the AIR.

    Its mean over held-out symbols is a lower bound on what a code can carry (mismatched decoding); it can be negative.
    """
    return np.asarray(np.log2(levels) + log_posterior(mu, kappa, symbols, levels) / np.log(2), np.float64)


def gray_rate(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int
) -> Floats:
    """Contribution of each symbol to the GMI of Gray-labelled bits (bit-metric decoding at scale 1), bits, 1-D.

    Sum over the log2 M bits of 1 + log2 posterior of the true bit.

    Raises:
        PageError: as `log_posterior`, or M is no power of two and has no Gray labels.
    """
    m, phase, k, s = _checked(mu, kappa, symbols, levels)
    if m & (m - 1):
        raise PageError("levels of a Gray-labelled page", m, "a power of two")
    bits = m.bit_length() - 1
    labels = np.arange(m) ^ (np.arange(m) >> 1)
    total = np.full(phase.size, float(bits))
    for rows in _chunks(phase.size):
        logits = _logits(phase.ravel()[rows], k.ravel()[rows], m)
        everything = logsumexp(logits, axis=1)
        sent = labels[s.ravel()[rows]]
        for bit in range(bits):
            alike = (labels[None, :] >> bit & 1) == (sent[:, None] >> bit & 1)
            total[rows] += (logsumexp(np.where(alike, logits, -np.inf), axis=1) - everything) / np.log(2)
    return total


@dataclass(frozen=True)
class ConfidenceBin:
    """Symbols of similar confidence: what was claimed of them against how often it was right."""

    low: float
    high: float
    count: int
    confidence: float
    """Mean over the bin."""
    accuracy: float
    """Share of right decisions."""


def reliability(
    confidence: NDArray[np.floating], correct: NDArray[np.bool_], bins: int = ECE_BINS
) -> list[ConfidenceBin]:
    """Claim and accuracy in `bins` bins of equal width on 0..1, in order; empty bins are left out.

    Args:
        confidence: posterior of each decided symbol, any shape.
        correct: whether the decision was right, same shape.
        bins: number of bins.

    Raises:
        PageError: no symbols.
    """
    c = np.asarray(confidence, np.float64).ravel()
    if c.size == 0:
        raise PageError("confidences", "none", "at least one")
    index = np.clip((c * bins).astype(int), 0, bins - 1)
    counts = np.bincount(index, minlength=bins)
    claimed = np.bincount(index, c, bins) / np.maximum(counts, 1)
    right = np.bincount(index, np.asarray(correct, np.float64).ravel(), bins) / np.maximum(counts, 1)
    return [
        ConfidenceBin(n / bins, (n + 1) / bins, int(counts[n]), float(claimed[n]), float(right[n]))
        for n in np.flatnonzero(counts).tolist()
    ]


def expected_calibration_error(
    confidence: NDArray[np.floating], correct: NDArray[np.bool_], bins: int = ECE_BINS
) -> float:
    """ECE: mean over symbols of |accuracy - mean confidence| of their bin; arguments and errors of `reliability`."""
    return calibration_error(reliability(confidence, correct, bins))


def calibration_error(bins: Sequence[ConfidenceBin]) -> float:
    """ECE of symbols in `bins`, at least one."""
    return sum(b.count * abs(b.accuracy - b.confidence) for b in bins) / sum(b.count for b in bins)


@dataclass(frozen=True)
class ConcentrationBin:
    """Symbols of similar concentration: what they promised against what happened."""

    low: float
    high: float
    count: int
    promised: float
    """Mean of I1/I0 over the bin."""
    observed: float
    """Mean cosine of the phase error."""


@dataclass(frozen=True)
class PageMeasures:
    """The figures of one set of symbols whose truth is known."""

    count: int
    levels: int
    air_bits_per_symbol: float
    own_mi_bits_per_symbol: float
    gmi_bits_per_symbol: float | None
    """None where M is no power of two."""
    symbol_error_rate: float
    ece: float

    @property
    def over_claim_bits_per_symbol(self) -> float:
        """Own-MI minus AIR: what the decoder claims beyond what a code could carry."""
        return self.own_mi_bits_per_symbol - self.air_bits_per_symbol


def measure(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int
) -> PageMeasures:
    """All figures of the symbols given, which should be data symbols only (pilots carry nothing).

    Args:
        mu: decoded phase, radians, piston already removed; any shape.
        kappa: concentration, same shape.
        symbols: the true symbols, same shape.
        levels: M.
    """
    truth = np.asarray(symbols)
    if truth.size == 0:
        raise PageError("symbols to measure", "none", "at least one")
    decided, confidence = decide_with_confidence(mu, kappa, levels)
    correct = decided == truth
    return PageMeasures(
        count=int(truth.size),
        levels=levels,
        air_bits_per_symbol=float(achievable_rate(mu, kappa, truth, levels).mean()),
        own_mi_bits_per_symbol=float(own_information(mu, kappa, levels).mean()),
        gmi_bits_per_symbol=None if levels & (levels - 1) else float(gray_rate(mu, kappa, truth, levels).mean()),
        symbol_error_rate=float(1 - correct.mean()),
        ece=expected_calibration_error(confidence, correct),
    )


@dataclass(frozen=True)
class SymbolMaps:
    """Means over pages at every place of the page, float64 [ny, nx], NaN at pilots.

    Attributes:
        air: bits.
        own_mi: bits, as the decoder claims.
        error_rad: of the phase error's magnitude, radians.
    """

    air: Floats
    own_mi: Floats
    error_rad: Floats


def symbol_maps(
    mu: NDArray[np.floating],
    kappa: NDArray[np.floating],
    symbols: NDArray[np.integer],
    levels: int,
    data: NDArray[np.bool_],
) -> SymbolMaps:
    """What `measure` averages over the page, place by place.

    Args:
        mu, kappa, symbols: of the data symbols, [pages, number of Trues in data] in row order.
        levels: M.
        data: where the data symbols are, bool [ny, nx].

    Raises:
        PageError: as `log_posterior`, or the number of symbols is not that of `data`.
    """
    m, phase, k, s = _checked(mu, kappa, symbols, levels)
    if phase.ndim != 2 or phase.shape[1] != np.count_nonzero(data):
        raise PageError("data symbols", f"shape {phase.shape}", f"(pages, {np.count_nonzero(data)})")

    def spread(values: Floats) -> Floats:
        page = np.full(data.shape, np.nan)
        page[data] = values.mean(axis=0)
        return page

    turned = s * (2 * np.pi / m) - phase
    error = np.abs(turned - 2 * np.pi * np.rint(turned / (2 * np.pi)))
    return SymbolMaps(spread(achievable_rate(phase, k, s, m)), spread(own_information(phase, k, m)), spread(error))


def _partition(phase: Floats, kappa: Floats, levels: int) -> tuple[Floats, Floats]:
    """log Z, Z = sum_k exp(kappa (cos(theta_k - mu) - 1)), and the posterior's mean of 1 - cos(theta_k - mu).

    Without M terms a symbol; log Z agrees with the plain sum to 1e-9. Z is M (I0 + 2 sum_n I_nM cos(n M mu))
    exp(-kappa): for kappa << M^2 only I0 counts. For a larger kappa only the levels near mu count.
    """
    if levels <= 2 * _WINDOW + 1:
        return _window_sums(phase, kappa, levels, np.arange(levels))
    smooth = kappa <= levels**2 / _ALIASING
    log_partition, away = np.log(levels) + np.log(i0e(kappa)), 1 - mean_resultant(kappa)
    if not smooth.all():
        near = _window_sums(phase[~smooth], kappa[~smooth], levels, np.arange(-_WINDOW, _WINDOW + 1))
        log_partition[~smooth], away[~smooth] = near
    return np.asarray(log_partition), np.asarray(away)


def _window_sums(phase: Floats, kappa: Floats, levels: int, offsets: NDArray[np.int_]) -> tuple[Floats, Floats]:
    step = 2 * np.pi / levels
    nearest = np.rint(phase / step) * step
    total, away = np.zeros_like(phase), np.zeros_like(phase)
    closest = 1 - np.cos(nearest - phase)
    for offset in offsets:
        distance = 1 - np.cos(nearest + offset * step - phase)
        weight = np.exp(kappa * (closest - distance))
        total += weight
        away += weight * distance
    return np.asarray(np.log(total) - kappa * closest), np.asarray(away / total)


def _logits(phase: Floats, kappa: Floats, levels: int) -> Floats:
    theta = np.arange(levels) * (2 * np.pi / levels)
    return np.asarray(kappa[:, None] * (np.cos(theta[None, :] - phase[:, None]) - 1))


def _chunks(size: int) -> Iterator[slice]:
    return (slice(start, start + _CHUNK) for start in range(0, size, _CHUNK))


def _concentration(kappa: NDArray[np.floating]) -> Floats:
    k = np.atleast_1d(np.asarray(kappa, np.float64))
    if not (k >= 0).all():
        raise PageError("concentration", "a negative value or NaN", "numbers of at least 0")
    return np.minimum(k, CONCENTRATION_CAP)


def _checked(
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int
) -> tuple[int, Floats, Floats, NDArray[np.int64]]:
    levels, phase, k = _checked_belief(mu, kappa, levels)
    s = np.atleast_1d(np.asarray(symbols))
    if phase.shape != s.shape:
        raise PageError("phase, symbols", (phase.shape, s.shape), "two equal shapes")
    if s.size and (int(s.min()) < 0 or int(s.max()) >= levels):
        raise PageError("symbols", f"{s.min()}..{s.max()}", f"0..{levels - 1}")
    return levels, phase, k, s.astype(np.int64)


def _checked_belief(mu: NDArray[np.floating], kappa: NDArray[np.floating], levels: int) -> tuple[int, Floats, Floats]:
    check_levels(levels)
    phase, k = np.atleast_1d(np.asarray(mu, np.float64)), _concentration(kappa)
    if phase.shape != k.shape:
        raise PageError("phase, concentration", (phase.shape, k.shape), "two equal shapes")
    if not np.isfinite(phase).all():
        raise PageError("decoded phase", "NaN or infinity", "finite radians")
    return levels, phase, k
