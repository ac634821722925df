"""Errors of a page's symbols that their levels, their neighbours, the page and the modulator's dead pixels explain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.words import counted

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_NAMED = 3
"""Places that are named."""
_BY_CHANCE = 1e-8
"""Probability that noise alone makes a symbol an outlier."""
_ON_EACH = 4.0
"""Least square of an outlier's error on each page by either camera, over the variance of errors. A symbol that is wrong
on one page alone has no dead pixel; one that is wrong by one camera alone has dust on it."""
_AROUND = 9
"""Side, symbols, of the square in which errors are usual."""
_OF_MEDIAN = 1.4826
"""Standard deviation of normal errors over the median of their magnitudes."""
_BLOCK = 5
"""Side, symbols, of the squares over which the variance of errors is compared with that of noise."""
_MOST_DEAD = 0.1
"""Largest share of symbols with dead pixels; more are symbols that were not written."""
_TINY = 1e-30


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


def flicker_variance(errors: Sequence[Complex], phases: Sequence[Real]) -> float:
    """Return the phase variance by changes of the modulator's stroke from page to page, rad^2; 0 for one page.

    Args:
        errors: relative errors of each page's symbols, [ny, nx].
        phases: phases of their levels, [ny, nx].
    """
    if len(errors) < 2:
        return 0.0
    ramps = [page - page.mean() for page in phases]
    slopes = np.array([np.sum(e.imag * ramp) / np.sum(ramp**2) for e, ramp in zip(errors, ramps, strict=True)])
    slopes = slopes - slopes.mean()
    chance = np.mean([np.mean(e.imag**2) / e.size for e in errors])
    variance = float(np.sum(slopes**2) / (len(slopes) - 1) * np.mean([np.mean(ramp**2) for ramp in ramps]))
    return max(0.0, variance - 2 * float(chance))


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


def outliers(errors: Sequence[Complex]) -> NDArray[np.bool_]:
    """Find symbols whose light is wrong on each of several pages by either camera, as by dead pixels of the modulator.

    A dark pixel changes the amplitude of its symbol, which noise of the modulator hardly does. So errors of amplitude
    and of phase count by their own deviations, which are those of the symbols around.

    Args:
        errors: relative errors of each page's symbols by either camera, [2, ny, nx].

    Returns:
        Where they are, bool [ny, nx].
    """
    parts = np.array([part for page in errors for camera in page for part in (camera.real, camera.imag)])
    usual = [scipy.ndimage.median_filter(np.abs(part), _AROUND) * _OF_MEDIAN for part in parts]
    by_view = np.sum(((parts / np.maximum(usual, _TINY)) ** 2).reshape(-1, 2, *parts.shape[1:]), axis=1)
    most = scipy.stats.chi2.isf(_BY_CHANCE, len(parts))
    where = (by_view.sum(axis=0) > most) & (by_view.min(axis=0) > _ON_EACH)
    return np.asarray(where & (np.mean(where) < _MOST_DEAD))


def outlier_bits(errors: Complex, noise: float) -> float:
    """Information that outliers lose, bits a symbol: an estimator that does not expect such errors trusts its phases.

    Args:
        errors: relative errors of the outliers, zero elsewhere, [ny, nx].
        noise: variance of a symbol's phase by noise.
    """
    held = np.log2(2 * np.pi) - np.log2(2 * np.pi * np.e * noise) / 2
    return float(np.mean(np.minimum(np.abs(errors) ** 2 / noise * np.log2(np.e) / 2, max(0.0, held))))


def named_outliers(where: NDArray[np.bool_]) -> str:
    """Name the first places of outliers, bool [ny, nx], in words; empty where there are none."""
    places = [f"row {row}, column {column}" for row, column in np.argwhere(where)[:_NAMED]]
    count = np.count_nonzero(where)
    return (
        f" ({counted(int(count), 'symbol')}: {'; '.join(places)}{'; ...' if count > _NAMED else ''})" if count else ""
    )
