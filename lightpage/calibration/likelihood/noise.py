"""Noise of estimated phases against what their Fisher information promises."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.von_mises import information as nats

Real = NDArray[np.float64]

_NORMAL = 0.4549
"""Median of the square of a normal error, over its variance."""
_SMALLEST = 1e-12
"""Smallest part of a variance, over its median, that is told from none."""


def fitted_noise(errors: Real, information: Real) -> NDArray[np.float32]:
    """Fit the noise of estimates by their errors: the variance of a phase is noise[0] / information + noise[1].

    The likelihood is that of von Mises densities of such concentration.

    Args:
        errors: phases less known ones, radians, [N].
        information: Fisher information of each, [N].

    Returns:
        [2]: factor on the variance that the information promises, and variance beside it, rad^2.
    """
    relative = information / np.median(information)
    variance = float(np.median(errors**2)) / _NORMAL

    def loss(logarithms: Real) -> float:
        concentration = 1 / (np.exp(logarithms[0]) / relative + np.exp(logarithms[1]))
        logarithm = np.log(scipy.special.i0e(concentration))
        return float(np.mean(logarithm - concentration * (np.cos(errors) - 1)))

    least = np.log(variance * _SMALLEST)
    bounds = [(least, 3.0)] * 2
    starts = [np.log(variance * np.array(shares)) for shares in ((0.9, 0.1), (0.1, 0.9))]
    found = [scipy.optimize.minimize(loss, start, method="Nelder-Mead", bounds=bounds) for start in starts]
    best = np.exp(min(found, key=lambda one: float(one.fun)).x)
    return np.array([best[0] * np.median(information), best[1]], np.float32)


def expected_bits(noise: NDArray[np.float32], information: Real) -> float:
    """Mean information of symbols with such noise, bits a symbol; see `fitted_noise`."""
    concentration = information / (noise[0] + noise[1] * information)
    return float(np.mean(nats(concentration)) / np.log(2))
