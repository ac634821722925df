"""The pipe's light on an axis from few samples of it: its band is narrow, and an axis may be as fine as it likes.

Between the samples it is a sum of sinc functions under a window, exp(b (sqrt(1 - v^2) - 1)) (Barnett, Magland and af
Klinteberg, SIAM J. Sci. Comput. 41, C479, 2019), which loses at most 2e-4 at the edge of the band.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from optics.profile import Profile

Real = NDArray[np.floating]

_OVER_NYQUIST = 1.3
_REACH = 14
"""Samples to either side that a place is interpolated from."""
_SHAPE = 8.5
"""b of the window."""


def sparse_axis(profile: Profile, places_m: Real) -> Real:
    """Places of the fewest samples that show the pipe's light on a uniform axis; the axis itself if it has no more.

    Args:
        profile: the device.
        places_m: the axis, on the camera plane.
    """
    period = profile.light.wavelength_m * profile.lens.focal_length_m / profile.pipe.width_m
    pitch = period / _OVER_NYQUIST
    if places_m[1] - places_m[0] >= pitch:
        return places_m
    half = np.ptp(places_m) / 2 + _REACH * pitch
    count = int(np.ceil(2 * half / pitch)) + 1
    return np.asarray((places_m[0] + places_m[-1]) / 2 + (np.arange(count) - (count - 1) / 2) * pitch)


def interpolation(places_m: Any, sparse_m: Any, xp: Any = np) -> Any:
    """Matrix [places, samples] from sparse samples of light to places between them; its transpose is its adjoint.

    As a lens has it, a sample is larger by the root of the area that it stands for.

    Args:
        places_m: uniform axis.
        sparse_m: `sparse_axis` of it.
        xp: numpy, or torch for axes that are tensors.
    """
    pitch = sparse_m[1] - sparse_m[0]
    away = (places_m[:, None] - sparse_m[None, :]) / pitch
    left = 1 - (away / _REACH) ** 2
    inside = left > 0
    window = xp.exp(_SHAPE * (xp.sqrt(xp.where(inside, left, 0 * left)) - 1))
    thinner = xp.sqrt((places_m[1] - places_m[0]) / pitch)
    return xp.where(inside, thinner * xp.sinc(away) * window, 0 * left)
