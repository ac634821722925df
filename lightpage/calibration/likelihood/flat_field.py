"""Flat field of a device: the phase error of each symbol that the fitted waves leave the same on every page."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]


class FlatField(NamedTuple):
    """Phase error of each symbol that repeats on all pages.

    Attributes:
        phases: of all pages, radians [ny, nx].
        by_others: for each page, of the other pages, radians [K, ny, nx].
    """

    phases: Real
    by_others: Real


def flat_field(errors: Real, variance: Real) -> FlatField:
    """Estimate the phase error that repeats at each symbol (empirical Bayes, as of normal errors).

    The mean over pages is shrunk by the share of its variance that repeats. That variance is the same for all symbols.
    It is estimated from all pairs of pages, where symbols of small variance weigh most.

    Args:
        errors: estimated phases minus known ones, radians [K, ny, nx].
        variance: expected squares of a symbol's errors, rad^2 [ny, nx].

    Returns:
        The flat field; zero where one page alone cannot show what repeats, or nothing does.
    """
    count = len(errors)
    mean = errors.mean(axis=0)
    if count < 2:
        return FlatField(np.zeros_like(mean), np.zeros_like(errors))
    products = (count * mean**2 - np.mean(errors**2, axis=0)) / (count - 1)  # mean over the pairs of pages
    repeated = max(0.0, float(np.average(products, weights=variance**-2)))
    noise = np.maximum(variance - repeated, 0)

    def shrinkage(pages: int) -> Real:
        return np.asarray(repeated / np.maximum(repeated + noise / pages, np.finfo(np.float64).tiny))

    others = (count * mean - errors) / (count - 1)
    return FlatField(shrinkage(count) * mean, shrinkage(count - 1) * others)
