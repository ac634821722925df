"""Figures of many pages, gathered page by page: of a symbol only its concentration and phase error are kept."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import PageError
from lightpage.metrics.information import CONCENTRATION_CAP, decide_with_confidence
from lightpage.metrics.measures import PageMeasures, SymbolMaps, measure, symbol_maps
from lightpage.metrics.reliability import ECE_BINS, ConcentrationBin, ConfidenceBin, calibration_error, reliability
from lightpage.page.levels import Levels
from lightpage.von_mises import mean_resultant

_INDEX_BITS = 33
_INDEX = np.uint64((1 << _INDEX_BITS) - 1)
_AT_ONCE = 1 << 16


class Accumulator:
    """Accumulator of the figures of `lightpage.metrics.information` over all pages, in twelve bytes a symbol.

    Args:
        levels: M, or uneven levels.
        data: mask of the data symbols, bool [ny, nx].
        pages: the most that are added.
    """

    def __init__(self, levels: int | Levels, data: NDArray[np.bool_], pages: int) -> None:
        self._levels, self._data = Levels.of(levels), data
        self._measures: list[PageMeasures] = []
        self._maps = np.zeros((3, *data.shape))
        self._reliability = np.zeros((3, ECE_BINS))
        symbols = pages * int(np.count_nonzero(data))
        # A key is a concentration's float32 bits, which rank as the number does, and behind them the symbol's index.
        self._keys = np.empty(symbols, np.uint64)
        self._cosines = np.empty(symbols, np.float32)
        self._count = 0

    @property
    def pages(self) -> tuple[PageMeasures, ...]:
        """The figures of each page."""
        return tuple(self._measures)

    def add(self, mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer]) -> None:
        """Count one page's data symbols, in row order: phases in radians, concentrations and true symbols, 1-D.

        Raises:
            PageError: as `measure` and `symbol_maps`.
        """
        page = measure(mu, kappa, symbols, self._levels)
        maps = symbol_maps(mu[None], kappa[None], symbols[None], self._levels, self._data)
        decided, confidence = decide_with_confidence(mu, kappa, self._levels)
        self._measures.append(page)
        self._maps += (maps.air, maps.own_mi, maps.error_rad)
        for part in reliability(confidence, decided == symbols):
            sums = part.count, part.count * part.confidence, part.count * part.accuracy
            self._reliability[:, round(part.low * ECE_BINS)] += sums
        self._rank(mu, kappa, symbols)

    def figures(self) -> PageMeasures:
        """Return the figures over the symbols of all pages.

        Raises:
            PageError: no pages.
        """
        pages = self._measures
        if not pages:
            raise PageError("pages to measure", "none", "at least one")
        gmi = [page.gmi_bits_per_symbol for page in pages if page.gmi_bits_per_symbol is not None]
        return PageMeasures(
            count=sum(page.count for page in pages),
            levels=self._levels.count,
            air_bits_per_symbol=float(np.mean([page.air_bits_per_symbol for page in pages])),
            own_mi_bits_per_symbol=float(np.mean([page.own_mi_bits_per_symbol for page in pages])),
            gmi_bits_per_symbol=float(np.mean(gmi)) if gmi else None,
            symbol_error_rate=float(np.mean([page.symbol_error_rate for page in pages])),
            ece=calibration_error(self.confidence_bins()),
        )

    def maps(self) -> SymbolMaps:
        """Means over the pages at every place of the page; NaN everywhere without pages."""
        return SymbolMaps(*(self._maps / (len(self._measures) or np.nan)))

    def confidence_bins(self) -> list[ConfidenceBin]:
        """Return what `reliability` returns for the symbols of all pages together."""
        counts, claimed, right = self._reliability
        return [
            ConfidenceBin(
                n / ECE_BINS,
                (n + 1) / ECE_BINS,
                int(counts[n]),
                float(claimed[n] / counts[n]),
                float(right[n] / counts[n]),
            )
            for n in np.flatnonzero(counts).tolist()
        ]

    def concentration_bins(self, bins: int = 10) -> list[ConcentrationBin]:
        """Promise and outcome in bins of equal count, ordered by concentration; empty bins are left out."""
        keys = self._keys[: self._count]
        keys.sort()
        return [self._concentration_bin(part) for part in np.array_split(keys, bins) if part.size]

    def _rank(self, mu: NDArray[np.floating], kappa: NDArray[np.floating], symbols: NDArray[np.integer]) -> None:
        added = slice(self._count, self._count + symbols.size)
        bits = np.minimum(kappa, CONCENTRATION_CAP).astype(np.float32).view(np.uint32).astype(np.uint64)
        self._keys[added] = bits << _INDEX_BITS | np.arange(added.start, added.stop, dtype=np.uint64)
        self._cosines[added] = np.cos(self._levels.phases[symbols] - np.asarray(mu, np.float64))
        self._count = added.stop

    def _concentration_bin(self, keys: NDArray[np.uint64]) -> ConcentrationBin:
        promised = observed = 0.0
        for start in range(0, keys.size, _AT_ONCE):
            part = keys[start : start + _AT_ONCE]
            promised += float(mean_resultant(_concentrations(part)).sum())
            observed += float(self._cosines[part & _INDEX].sum(dtype=np.float64))
        low, high = _concentrations(keys[[0, -1]]).tolist()
        return ConcentrationBin(low, high, keys.size, promised / keys.size, observed / keys.size)


def _concentrations(keys: NDArray[np.uint64]) -> NDArray[np.float64]:
    return (keys >> _INDEX_BITS).astype(np.uint32).view(np.float32).astype(np.float64)
