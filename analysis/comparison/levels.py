"""Calibration of confidences on pages of few levels, where most decisions are right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.metrics.measures import measure
from lightpage.recording.reader import Recording

JUDGED = 0.01, 0.3
"""Symbol error rates between which the calibration of confidences is judged: few errors, or many, say little of it."""


@dataclass(frozen=True)
class LevelFigures:
    """Figures of pages with `levels` levels; rates in bits per data symbol."""

    levels: int
    symbol_error_rate: float
    ece: float
    air: float
    own_mi: float
    gmi: float | None

    def line(self, method: str, size: str) -> str:
        low, high = JUDGED
        outside = "" if low <= self.symbol_error_rate <= high else "  not judged"
        return (
            f"{method:<16} {size:<9} {self.levels:>6} {self.symbol_error_rate:>9.4f} {self.ece:>7.4f} {self.air:>7.3f} "
            f"{self.own_mi:>7.3f} {'' if self.gmi is None else f'{self.gmi:.3f}':>7}{outside}"
        )


LEVEL_HEADER = f"{'method':<16} {'size':<9} {'levels':>6} {'error':>9} {'ECE':>7} {'AIR':>7} {'own-MI':>7} {'GMI':>7}"


def level_figures(
    p: NDArray[np.float32], recording: Recording, pages: Sequence[int], mask: NDArray[np.bool_]
) -> LevelFigures:
    """Figures of decoded pages.

    Args:
        p: estimates of the data symbols, [2, symbols].
        recording: recording with the truth.
        pages: numbers of its pages, in order.
        mask: pilots, bool [ny, nx].
    """
    written = [recording.symbols(page) for page in pages]
    symbols = np.concatenate([page[~mask] for page in written if page is not None])
    figures = measure(np.arctan2(p[1], p[0]), np.hypot(p[0], p[1]), symbols, recording.levels)
    return LevelFigures(
        recording.levels,
        figures.symbol_error_rate,
        figures.ece,
        figures.air_bits_per_symbol,
        figures.own_mi_bits_per_symbol,
        figures.gmi_bits_per_symbol,
    )
