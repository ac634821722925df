"""The smooth phase error that pages of one device share, as their pilots together show it.

A decoder whose geometry is a little off reads each symbol with an error that is smooth over the page, and the same on
every page. A fit by the decoder's own decisions would take it for the device's: any smooth phase agrees with decisions
that were made through it. Pilots are known whatever the page holds. Those of a few pages tell the error well enough to
decide the other symbols, and with it what the modulator's levels have changed by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander2d
from numpy.typing import NDArray

from lightpage.errors import CalibrationError
from lightpage.page import modulation as modulations
from lightpage.page.modulation import Modulation

Real = NDArray[np.float64]

_ORDER = 6
"""Of the polynomial over the page: on the bench device 0.1 degree of the pipe's angle leaves 0.05 radian of 0.2."""
_SCALES_RAD = 0.3, 0.1, 0.03, 0.01
"""Standard deviations of the polynomial's coefficients, over one more than their order, of which one is chosen."""
_PISTON_RAD = 0.3
"""Standard deviation of what is left of a page's piston."""
_CAP = 1e4
"""Largest concentration that counts as such."""
_ROUNDS = 15
"""Of reweighting."""
_OUTLIER = 2.0
"""Deviations from which on a pilot weighs half: a page's edges are read worse than they claim."""
_MEDIAN_CHI2 = 0.4549
"""Of the chi-squared distribution with one degree of freedom."""
_STROKE_DEVIATIONS = 3.0
"""Deviations of the stroke from which on the modulator counts as changed."""


@dataclass(frozen=True)
class CommonError:
    """Error that is to be taken off the phases of some pages.

    Attributes:
        phase: radians [ny, nx], on all of them.
        pistons: radians [pages].
        modulation: what the modulator makes of its levels; the earlier one where pilots do not tell it from that.
        scale: deviations of the pilots from what is left, over what the decoder claims; at least 1.
    """

    phase: Real
    pistons: Real
    modulation: Modulation
    scale: float


def common_error(
    phases: Real, concentrations: Real, mask: NDArray[np.bool_], written: Real, modulation: Modulation
) -> CommonError:
    """Fit the error by the pilots of all pages.

    Args:
        phases: decoded, radians [pages, ny, nx]; each page's piston is off but for a fraction of a radian.
        concentrations: von Mises kappa, the same shape.
        mask: where the pilots are, bool [ny, nx].
        written: nominal phases of the pilots, radians, one a True in `mask` in row order.
        modulation: as it was calibrated.

    Raises:
        CalibrationError: phases or claims that are not finite.
    """
    if not (np.isfinite(phases).all() and np.isfinite(concentrations).all()):
        raise CalibrationError("pilots", "NaN or infinity", "finite phases and concentrations")
    pages, (ny, nx) = len(phases), mask.shape
    smooth, order = _polynomials(ny, nx)
    levels = modulations.basis(written).T
    away = phases[:, mask] - modulation.phase(written)
    away = (away - 2 * np.pi * np.rint(away / (2 * np.pi))).ravel()
    weight = np.minimum(concentrations[:, mask], _CAP).ravel()
    each = np.repeat(np.eye(pages), len(written), axis=0)
    terms = np.concatenate([np.tile(smooth[mask.ravel()], (pages, 1)), np.tile(levels, (pages, 1)), each], axis=1)
    of_levels = modulations.DRIFTS[: levels.shape[1]]
    found = min(
        (
            _fitted(terms, away, weight, np.concatenate([scale / (1 + order), of_levels, np.full(pages, _PISTON_RAD)]))
            for scale in _SCALES_RAD
        ),
        key=lambda fit: fit.missed,
    )
    first = smooth.shape[1]
    series, pistons = found.coefficients[first:-pages], found.coefficients[-pages:]
    changed = abs(series[0]) > _STROKE_DEVIATIONS * found.deviations[first]
    if changed:
        amplitudes = modulation.coefficients[len(series) :]
        told = np.add(modulation.coefficients[: len(series)], series)
        modulation = Modulation((*told.tolist(), *amplitudes))
    return CommonError((smooth @ found.coefficients[:first]).reshape(ny, nx), pistons, modulation, found.scale)


@dataclass(frozen=True)
class _Fit:
    """A robust fit, and by how much it misses pilots that it has not seen."""

    coefficients: Real
    deviations: Real
    scale: float
    missed: float


def _fitted(terms: Real, away: Real, weight: Real, prior: Real) -> _Fit:
    """Least squares with weights that fall for what lies far off, as Student's t has them."""
    own, left2, scale2 = weight, weight, 1.0
    found, covariance = np.zeros(terms.shape[1]), np.diag(prior**2)
    for _ in range(_ROUNDS):
        covariance = np.asarray(np.linalg.inv((terms.T * own) @ terms + np.diag(1 / prior**2)), np.float64)
        found = covariance @ (terms.T @ (own * away))
        left2 = weight * (away - terms @ found) ** 2
        scale2 = max(float(np.median(left2)) / _MEDIAN_CHI2, 1.0)
        own = weight / scale2 / (1 + left2 / (scale2 * _OUTLIER**2))
    felt = np.minimum(np.einsum("ij,jk,ik->i", terms, covariance, terms) * own, 1 - 1e-6)
    unseen2 = left2 / (1 - felt) ** 2
    missed = float(np.mean(np.log1p(unseen2 / _OUTLIER**2)))
    return _Fit(found, np.sqrt(np.diag(covariance)), float(np.sqrt(scale2)), missed)


def _polynomials(ny: int, nx: int) -> tuple[Real, Real]:
    """Legendre polynomials over the page, [ny nx, terms], and the order of each; without the constant one."""
    y, x = np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")
    order = np.add.outer(np.arange(_ORDER + 1), np.arange(_ORDER + 1)).ravel()
    kept = (order > 0) & (order <= _ORDER)
    smooth = legvander2d(x.ravel(), y.ravel(), [_ORDER, _ORDER])[:, kept]
    return np.asarray(smooth, np.float64), order[kept].astype(np.float64)
