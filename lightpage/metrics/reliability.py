"""Reliability: how often decisions are right, and phases as close, as confidences and concentrations claim."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import PageError

ECE_BINS = 15


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
