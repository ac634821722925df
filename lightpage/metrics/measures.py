"""All figures of held-out symbols together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lightpage.errors import PageError
from lightpage.metrics.information import (
    Floats,
    achievable_rate,
    checked,
    decide_with_confidence,
    gray_rate,
    own_information,
)
from lightpage.metrics.reliability import expected_calibration_error
from lightpage.page.levels import Levels

SMOOTH = 5
"""Symbols along each side of the square over which maps are smoothed."""


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
    mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer], levels: int | Levels
) -> PageMeasures:
    """All figures of the symbols given, which should be data symbols only (pilots carry nothing).

    Args:
        mu: decoded phase, radians, piston already removed; any shape.
        kappa: concentration, same shape.
        symbols: the true symbols, same shape.
        levels: M, or uneven levels.
    """
    truth, levels = np.asarray(symbols), Levels.of(levels)
    if truth.size == 0:
        raise PageError("symbols to measure", "none", "at least one")
    decided, confidence = decide_with_confidence(mu, kappa, levels)
    correct = decided == truth
    return PageMeasures(
        count=int(truth.size),
        levels=levels.count,
        air_bits_per_symbol=float(achievable_rate(mu, kappa, truth, levels).mean()),
        own_mi_bits_per_symbol=float(own_information(mu, kappa, levels).mean()),
        gmi_bits_per_symbol=float(gray_rate(mu, kappa, truth, levels).mean()) if levels.carry_bits else None,
        symbol_error_rate=float(1 - correct.mean()),
        ece=expected_calibration_error(confidence, correct),
    )


@dataclass(frozen=True)
class SymbolMaps:
    """Means over pages at every place of the page, float64 [ny, nx], NaN at pilots.

    Attributes:
        air: bits.
        own_mi: bits, as the decoder claims.
        error_rad: magnitude of the phase error, radians.
    """

    air: Floats
    own_mi: Floats
    error_rad: Floats


def symbol_maps(
    mu: NDArray[np.floating],
    kappa: NDArray[np.floating],
    symbols: NDArray[np.integer],
    levels: int | Levels,
    data: NDArray[np.bool_],
) -> SymbolMaps:
    """Return maps over the page of what `measure` averages over it.

    Args:
        mu, kappa, symbols: estimates and truth of the data symbols, [pages, number of Trues in data] in row order.
        levels: M, or uneven levels.
        data: mask of the data symbols, bool [ny, nx].

    Raises:
        PageError: as `log_posterior`, or the number of symbols is not that of `data`.
    """
    m, phase, k, s = checked(mu, kappa, symbols, levels)
    if phase.ndim != 2 or phase.shape[1] != np.count_nonzero(data):
        raise PageError("data symbols", f"shape {phase.shape}", f"(pages, {np.count_nonzero(data)})")

    def spread(values: Floats) -> Floats:
        page = np.full(data.shape, np.nan)
        page[data] = values.mean(axis=0)
        return page

    turned = m.phases[s] - phase
    error = np.abs(turned - 2 * np.pi * np.rint(turned / (2 * np.pi)))
    return SymbolMaps(spread(achievable_rate(phase, k, s, m)), spread(own_information(phase, k, m)), spread(error))


def smoothed(values: Floats) -> Floats:
    """Return the means of a map [ny, nx] over `SMOOTH` x `SMOOTH` symbols around each, without what is NaN."""
    padded = np.pad(values, SMOOTH // 2, constant_values=np.nan)
    return np.asarray(np.nanmean(sliding_window_view(padded, (SMOOTH, SMOOTH)), axis=(2, 3)), np.float64)
