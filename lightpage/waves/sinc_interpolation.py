"""Light on an axis from few samples of it: its band is narrow, and an axis may be as fine as it likes.

Between the samples it is a sum of sinc functions under a window, exp(b (sqrt(1 - v^2) - 1)) (Barnett, Magland and af
Klinteberg, SIAM J. Sci. Comput. 41, C479, 2019). The finer the samples, the less a plane wave errs: at the edge of the
band by 1e-4 with the usual rate, in double precision, and on average over the band by 0.003 with a rate of 1.1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.floating]

OVERSAMPLING = 1.3
"""Samples, over two for each period of the highest frequency."""
_REACH = 14
"""Samples to either side that a place is interpolated from."""
_STEEPNESS = 0.84
"""b of the window over pi times the reach times 1 - 1/oversampling."""


def sparse_axis(places_m: Real, highest: float, oversampling: float = OVERSAMPLING) -> Real:
    """Uniform places of samples from which light is known on a uniform axis; the axis itself if it has no more.

    Args:
        places_m: the axis.
        highest: frequency of the light, cycles a metre.
        oversampling: samples over two a period of it.
    """
    pitch = 1 / (2 * oversampling * highest)
    count = int(np.ceil(np.ptp(places_m) / pitch)) + 2 * _REACH + 1
    if count >= len(places_m):
        return places_m
    return np.asarray((places_m[0] + places_m[-1]) / 2 + (np.arange(count) - (count - 1) / 2) * pitch)


def interpolation(places_m: Real, sparse_m: Real, oversampling: float = OVERSAMPLING) -> Real:
    """Matrix [places, samples] from light at its samples to light at places; its transpose is its adjoint.

    A sample's light is larger by the root of the length that it stands for, as lenses have it; so a place's is smaller.

    Args:
        places_m: uniform axis.
        sparse_m: `sparse_axis` of it, with that oversampling.
        oversampling: see there.
    """
    shape = _STEEPNESS * np.pi * _REACH * (1 - 1 / oversampling)
    pitch = sparse_m[1] - sparse_m[0]
    away = (places_m[:, None] - sparse_m[None, :]) / pitch
    left = 1 - (away / _REACH) ** 2
    inside = left > 0
    window = np.exp(shape * (np.sqrt(np.where(inside, left, 0.0)) - 1))
    smaller = np.sqrt((places_m[1] - places_m[0]) / pitch)
    return np.where(inside, smaller * np.sinc(away) * window, 0.0)
