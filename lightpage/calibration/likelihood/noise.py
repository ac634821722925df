"""Noise of estimated phases, compared with the Cramér-Rao bound of their Fisher information."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.von_mises import information as nats

Real = NDArray[np.float64]

_MEDIAN_CHI2 = 0.4549
"""Median of the square of a normal error, over its variance."""
_LEAST_VARIANCE = 1e-12
"""Least variance of an error, rad^2: less than float32 can tell."""
_CONVERGED = 1e-7
"""Relative change of the log-likelihood at which the noise is fitted: far less than changes the information."""
_LEAST_SHARE = 1e-12
"""Least share of the variance that either part of the noise may have."""


def fitted_noise(errors: Real, information: Real) -> NDArray[np.float32]:
    """Fit the noise of estimated phases by maximum likelihood.

    An error has a von Mises density of concentration 1 / (noise[0] / information + noise[1]).

    Args:
        errors: estimated phases minus known ones, radians, [N].
        information: Fisher information of each phase, [N].

    Returns:
        Noise: the factor on the Cramér-Rao bound, and an additional variance that all phases share, rad^2, [2].
    """
    relative = information / np.median(information)
    variance = max(float(np.median(errors**2)) / _MEDIAN_CHI2, _LEAST_VARIANCE)

    cosines = np.cos(errors)

    def loss(logarithms: Real) -> tuple[float, Real]:
        """Mean of the negative log-likelihood up to a constant, and its gradient."""
        factor, additional = np.exp(logarithms)
        concentration = 1 / (factor / relative + additional)
        scaled_bessel = scipy.special.i0e(concentration)
        values = np.log(scaled_bessel) - concentration * (cosines - 1)
        by_variance = -(concentration**2) * (scipy.special.i1e(concentration) / scaled_bessel - cosines)
        gradient = np.array([factor * np.mean(by_variance / relative), additional * np.mean(by_variance)])
        return float(np.mean(values)), gradient

    least = np.log(variance * _LEAST_SHARE)
    bounds = [(least, 3.0)] * 2
    starts = [np.log(variance * np.array(shares)) for shares in ((0.9, 0.1), (0.1, 0.9))]
    fits = [
        scipy.optimize.minimize(loss, start, method="L-BFGS-B", jac=True, bounds=bounds, options={"ftol": _CONVERGED})
        for start in starts
    ]
    best = np.exp(min(fits, key=lambda fit: float(fit.fun)).x)
    return np.array([best[0] * np.median(information), best[1]], np.float32)


def light_bits(information: Real, frame_error_rad: float, modulator_error_rad: float) -> float:
    """Information of symbols' light on their phases, bits a symbol.

    The Fisher information of counts takes noise of the modulator for noise of the counts, of which it is no part: it
    is the same in all samples that a symbol's light reaches. So its share of the errors is replaced by its own.

    Args:
        information: Fisher information of each symbol's phase.
        frame_error_rad, modulator_error_rad: standard deviations of a symbol's phase by either noise.
    """
    frames = frame_error_rad**2
    modulator = modulator_error_rad**2
    share = frames / (frames + modulator) if modulator > 0 else 1.0
    return expected_bits(np.array([share, modulator], np.float32), information)


def expected_bits(noise: NDArray[np.float32], information: Real) -> float:
    """Expected information of symbols, bits a symbol.

    Args:
        noise: see `fitted_noise`, [2].
        information: Fisher information of each symbol's phase.
    """
    concentration = information / (noise[0] + noise[1] * information)
    return float(np.mean(nats(concentration)) / np.log(2))
