"""Flat field of a device: the phase error of each symbol that the fitted waves leave the same on every page."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]


class FlatField(NamedTuple):
    """Mean phase error of each symbol.

    Attributes:
        phases: of all pages, radians [ny, nx].
        by_others: for each page, of the other pages, radians [K, ny, nx].
    """

    phases: Real
    by_others: Real


def flat_field(errors: Real) -> FlatField:
    """Estimate the phase error that repeats at each symbol (empirical Bayes, as of normal errors).

    The variance of the mean over pages shows how much of the error repeats. By that the mean is shrunk.

    Args:
        errors: estimated phases minus known ones, radians [K, ny, nx].

    Returns:
        The flat field; zero where one page alone cannot show what repeats, or nothing does.
    """
    count = len(errors)
    mean = errors.mean(axis=0)
    if count < 2:
        return FlatField(np.zeros_like(mean), np.zeros_like(errors))
    total = float(np.mean(errors**2))
    repeated = max(0.0, (count * float(np.mean(mean**2)) - total) / (count - 1))

    def shrinkage(pages: int) -> float:
        return repeated / max(repeated + (total - repeated) / pages, np.finfo(np.float64).tiny)

    others = (count * mean - errors) / (count - 1)
    return FlatField(shrinkage(count) * mean, shrinkage(count - 1) * others)
