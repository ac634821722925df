"""The density exp(kappa cos(theta - mu)) / (2 pi I0(kappa)) of an angle, by which decoders state what they know."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e, i1e

Floats = NDArray[np.float64]


def mean_resultant(kappa: Floats) -> Floats:
    """I1(kappa) / I0(kappa): the mean cosine of the error that a concentration promises."""
    return np.asarray(i1e(kappa) / i0e(kappa), np.float64)


def information(kappa: Floats) -> Floats:
    """Return the information on an angle that a concentration claims, nats: mean log density over the uniform one."""
    scaled = i0e(kappa)
    return np.asarray(kappa * (i1e(kappa) / scaled - 1) - np.log(scaled), np.float64)
