"""Fisher information of a device's symbols, measured on its known pages by finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.likelihood.interfaces import ProgressCallback
from lightpage.calibration.likelihood.known_page_fit import NUISANCES, KnownPageFit, nuisance_precision
from lightpage.calibration.sampling_table import SamplingTable

Real = NDArray[np.float64]

_PROBES = 4
"""Random directions for each page in which the curvature is probed."""
_SMOOTHED = 1.5
"""Standard deviation, symbols, of the filter of the information, which varies slowly except at the walls' shadows."""
_DEVIATIONS = 4.0
"""Standard deviations below the median about a symbol from which on its light lies beside a camera, and its information
is not smoothed. That of other symbols varies with the light of the others, on a page of the bench device by 0.18."""
_LEAST_SEEN = 0.9
"""Share of its light on both cameras below which rays tell that a symbol's light lies beside a camera."""
_LEAST_BESIDE = 0.002
"""Least information of such a symbol, over the median about it. In the dimmest light it has a large error."""
_MOST_SPREAD_BESIDE = 0.5
"""Largest standard deviation of the information with which such symbols keep their own."""
_MOST_SPREAD = 0.2
"""Largest standard deviation of the information about its median with which such symbols are told from chance."""
_DAMPING = 2.0
"""Factor on the information of such symbols. They share what little of their light the cameras measure, and steps by
their own information alone would overshoot together, and swing."""
_MEDIAN = 5
"""Side of the median filters, symbols."""
_SOLVER_ROUNDS = 5
"""Rounds of conjugate gradients for each response."""
_FITTED = [0, 2, 3, 4, 5]
"""Nuisance parameters that a step fits. The phase of the gain is the page's piston, which the pilots give."""
_TINY = 1e-12
_LEAST_INFORMATION = 1e-3
"""Least information, over the page's median."""


def measured_information(
    fit: KnownPageFit, seen: Real, progress: ProgressCallback = lambda share: None
) -> SamplingTable:
    """Measure the Fisher information of the symbols, and how they couple with the nuisance parameters.

    Args:
        fit: fit of the known pages, with gains and statistics of the counts.
        seen: share of each symbol's light that lands on both cameras, [ny, nx]; see `seen_share`.
        progress: called with the finished share of the work.

    Returns:
        `count_scale` and `count_weights`, see `count_tensors`; `information` [ny, nx] of the symbols of a page of unit
        gain; `responses` [5, ny, nx] of the phases to relative gain, tilt and shift; `nuisance_covariance` [5, 5] of
        these; and `nuisance_precision` [4] of tilt and shift before a page is read.
    """
    shape = fit.pages[0].phases.shape
    curvature = np.zeros(shape)
    couplings = np.zeros((NUISANCES, *shape))
    normal = np.zeros((NUISANCES, NUISANCES))
    rng = np.random.default_rng(0)
    count = len(fit.pages)
    for number, page in enumerate(fit.pages):
        progress(number / (count + 1))
        fit.fit_nuisance(page)
        current = fit.evaluate(page)
        for _ in range(_PROBES):
            probe = rng.choice([-1.0, 1.0], shape)
            curvature += probe * fit.hessian_product(page, current, probe) / _PROBES / page.power_gain
        couplings += fit.couplings(page, current) / page.power_gain
        normal += fit.normal_equations([*fit.by_nuisance(page, current)], current)[1] / page.power_gain
    information = _smoothed(curvature / count, seen)
    information = np.maximum(information, _LEAST_INFORMATION * np.median(information))
    couplings = np.stack([scipy.ndimage.median_filter(each, _MEDIAN) for each in couplings[_FITTED] / count])
    progress(count / (count + 1))
    responses = _responses(fit, information, couplings)
    precision = nuisance_precision()[_FITTED]
    schur = (normal / count)[np.ix_(_FITTED, _FITTED)] - np.einsum("kyx,lyx->kl", couplings, responses)
    schur = (schur + schur.T) / 2 + np.diag(precision)
    return {
        **{name: fit.table[name] for name in ("count_scale", "count_weights")},
        "information": information.astype(np.float32),
        "responses": responses.astype(np.float32),
        "nuisance_covariance": np.linalg.inv(schur).astype(np.float32),
        "nuisance_precision": precision[1:].astype(np.float32),
    }


def _smoothed(information: Real, seen: Real) -> Real:
    """Smooth information [ny, nx] but that of symbols whose light lies beside a camera, which is damped.

    Rays tell which these are, and where information varies little from page to page, it tells itself.

    Args:
        information: measured information.
        seen: share of each symbol's light that lands on both cameras.
    """
    usual = scipy.ndimage.median_filter(information, _MEDIAN)
    relative = information / np.where(usual > 0, usual, 1)
    spread = scipy.stats.median_abs_deviation(relative, axis=None, scale="normal")
    dark = (relative < 1 - _DEVIATIONS * spread) & (spread <= _MOST_SPREAD)
    beside = (seen < _LEAST_SEEN) & (relative < 1) & (spread <= _MOST_SPREAD_BESIDE)
    information = np.where(beside, np.maximum(information, _LEAST_BESIDE * usual), information)
    dark |= beside
    total = scipy.ndimage.gaussian_filter(np.where(dark, 0, information), _SMOOTHED)
    weight = scipy.ndimage.gaussian_filter((~dark).astype(np.float64), _SMOOTHED)
    return np.where(dark, _DAMPING * information, total / np.maximum(weight, _TINY))


def _responses(fit: KnownPageFit, information: Real, couplings: Real) -> Real:
    """Solve the Hessian of the phases for each coupling [K, ny, nx], at the first page.

    A response is the change of all phases that compensates a unit change of a nuisance parameter best.
    """
    page = fit.pages[0]
    current = fit.evaluate(page)

    def product(direction: Real) -> Real:
        size = float(np.sqrt(np.mean(direction**2)))
        return fit.hessian_product(page, current, direction / size) * size / page.power_gain

    solutions = [_conjugate_gradients(product, coupling, information) for coupling in couplings]
    return np.stack([scipy.ndimage.median_filter(solution, _MEDIAN) for solution in solutions])


def _conjugate_gradients(product: Callable[[Real], Real], right: Real, diagonal: Real) -> Real:
    """Solve `product`(solution) = `right` by conjugate gradients, preconditioned by a diagonal, [ny, nx] each."""
    solution = np.zeros_like(right)
    residual = right
    preconditioned = residual / diagonal
    direction = preconditioned
    power = np.sum(residual * preconditioned)
    for _ in range(_SOLVER_ROUNDS):
        curved = product(direction)
        length = power / np.sum(direction * curved)
        solution = solution + length * direction
        residual = residual - length * curved
        preconditioned = residual / diagonal
        previous_power = power
        power = np.sum(residual * preconditioned)
        direction = preconditioned + power / previous_power * direction
    return solution
