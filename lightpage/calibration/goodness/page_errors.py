"""Errors of a page's symbols that their levels, their neighbours, the page and the modulator's dead pixels explain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_NAMED = 3
"""Places that are named."""
_OUTLIER = 4.5
"""Deviations from which on the root mean square of a symbol's errors on two pages is none of noise: chance has it in
one symbol of 10^8."""
_ON_EACH = 0.5
"""Least error on each page, over the root mean square: a symbol that is wrong on one page alone has no dead pixel."""
_BLOCK = 5
"""Side, symbols, of the squares over which the variance of errors is compared with that of noise."""
_LEAST_ERROR = 0.03
"""Least error of a symbol with a dead pixel, relative to its light: half of what one pixel of 16 causes."""
_MOST_DEAD = 0.1
"""Largest share of symbols with dead pixels; more are symbols that were not written."""


class Explained(NamedTuple):
    """Errors of a page's symbols, with the part that something explains.

    Attributes:
        residual: errors without that part, [ny, nx].
        part: that part, as far as it is not chance, [ny, nx].
        variance: its phase variance beyond that of chance, rad^2.
    """

    residual: Complex
    part: Complex
    variance: float


class DeadPixels(NamedTuple):
    """Symbols with dead pixels of the modulator.

    Attributes:
        where: symbols, [ny, nx].
        power: mean square of their errors of phase, over all symbols.
        bits: information that they lose, bits a symbol of the page.
    """

    where: NDArray[np.bool_]
    power: float
    bits: float

    def __str__(self) -> str:
        """First places in words."""
        places = [f"row {row}, column {column}" for row, column in np.argwhere(self.where)[:_NAMED]]
        count = np.count_nonzero(self.where)
        return f" ({count} symbols: {'; '.join(places)}{'; ...' if count > _NAMED else ''})" if count else ""


def without_flicker(errors: Sequence[Complex], phases: Sequence[Real]) -> tuple[list[Complex], float]:
    """Take the change of the modulator's stroke from page to page off the errors of several pages.

    Args:
        errors: relative errors of each page's symbols, [ny, nx].
        phases: phases of their levels, [ny, nx].

    Returns:
        Errors without it, and its variance, rad^2.
    """
    if len(errors) < 2:
        return list(errors), 0.0
    ramps = [page - page.mean() for page in phases]
    slopes = np.array([np.sum(e.imag * ramp) / np.sum(ramp**2) for e, ramp in zip(errors, ramps, strict=True)])
    slopes = slopes - slopes.mean()
    chance = np.mean([np.mean(e.imag**2) / e.size for e in errors])
    variance = float(np.sum(slopes**2) / (len(slopes) - 1) * np.mean([np.mean(ramp**2) for ramp in ramps]))
    kept = [e - 1j * slope * ramp for e, slope, ramp in zip(errors, slopes, ramps, strict=True)]
    return kept, max(0.0, variance - 2 * float(chance))


def without_levels(errors: Complex, phases: Real) -> Explained:
    """Take the mean of their level off the errors.

    Args:
        errors: relative errors of the symbols, [ny, nx].
        phases: phases of their levels, [ny, nx].
    """
    _, level = np.unique(np.round(phases.ravel(), 6), return_inverse=True)
    count = np.bincount(level)
    flat = errors.ravel()
    mean = (np.bincount(level, flat.real) + 1j * np.bincount(level, flat.imag)) / count
    several = count[level] > 1
    unbiased = np.sqrt(count[level] / np.maximum(count[level] - 1, 1))
    residual = np.where(several, (flat - mean[level]) * unbiased, flat)
    chance = np.mean(residual.imag**2) * len(count) / len(flat)
    power = float(np.mean(mean.imag[level] ** 2))
    variance = max(0.0, power - float(chance))
    part = 1j * mean.imag[level] * (variance / power if power > 0 else 0.0)
    return Explained(residual.reshape(errors.shape), part.reshape(errors.shape), variance)


def without_neighbours(errors: Complex, neighbourhood: Real) -> Explained:
    """Take phases that depend on the neighbouring symbols off the errors.

    Fringing fields between the modulator's pixels cause such phases, which follow the steps to the neighbours. The fit
    of the stroke already explains the part that depends on the symbol's own level.

    Args:
        errors: relative errors of the symbols, [ny, nx].
        neighbourhood: terms of the steps to the neighbours, [K, ny, nx]; see `steps_to_neighbours`.
    """
    matrix = neighbourhood.reshape(len(neighbourhood), -1).T
    explained = matrix @ np.linalg.lstsq(matrix, errors.imag.ravel(), rcond=None)[0]
    part = 1j * explained.reshape(errors.shape)
    residual = errors - part
    chance = len(neighbourhood) * np.mean(residual.imag**2) / residual.size
    return Explained(residual, part, max(0.0, float(np.mean(explained**2) - chance)))


def steps_to_neighbours(phases: Real) -> Real:
    """Terms of the steps from each symbol of a page [ny, nx] to its neighbours, along both axes, [4, ny, nx]."""
    terms = []
    for axis in (0, 1):
        beside = [np.roll(phases, shift, axis) for shift in (1, -1)]
        terms += [beside[0] + beside[1] - 2 * np.pi, np.sin(beside[0] - phases) + np.sin(beside[1] - phases)]
    return np.stack(terms)


def lost_bits(errors: Complex, noise: float) -> float:
    """Information that errors of phase lose beyond those of noise, bits a symbol; where errors are, and not elsewhere.

    Args:
        errors: relative errors of the symbols, [ny, nx].
        noise: variance of a symbol's phase by noise.
    """
    variance = scipy.ndimage.uniform_filter(errors.imag**2, _BLOCK)
    return float(np.mean(np.log2(np.maximum(variance / noise, 1)))) / 2


def dead_pixels(errors: Sequence[Complex], noise: float) -> DeadPixels:
    """Find symbols whose light is wrong on all of several pages.

    Args:
        errors: relative errors of each page's symbols, [ny, nx].
        noise: variance of a symbol's phase by noise.
    """
    magnitudes = np.abs(errors)
    typical = np.sqrt(np.mean(magnitudes**2, axis=0))
    usual = max(float(scipy.stats.median_abs_deviation(each.imag, axis=None, scale="normal")) for each in errors)
    where = (typical > max(_OUTLIER * usual, _LEAST_ERROR)) & (magnitudes.min(axis=0) > _ON_EACH * typical)
    if len(errors) < 2 or np.mean(where) > _MOST_DEAD:
        where = np.zeros_like(where)
    wrong = np.where(where, errors[0].imag ** 2, 0)
    return DeadPixels(where, float(np.mean(wrong)), float(np.mean(np.log2(1 + wrong / noise))) / 2)
