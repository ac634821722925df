"""Crosstalk of a modulator: the phase that a symbol takes on from the symbols beside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.von_mises import mean_resultant

Real = NDArray[np.float64]


def of_neighbours(phases: NDArray[np.floating], shares: tuple[float, float], certainty: Real | float = 1.0) -> Real:
    """Phase that crosstalk adds to each symbol of a page, radians [ny, nx].

    It is a share of what both neighbours' phases, 0 to 2 pi, have beyond pi. A symbol at the edge of the page stands in
    for the neighbour that it lacks.

    Args:
        phases: phases of the symbols, radians, any winding, [ny, nx].
        shares: shares along x and along y.
        certainty: of each phase, 0 to 1: of what is not known, the mean counts.
    """
    if not any(shares):
        return np.zeros(phases.shape)
    beyond = np.pad(certainty * (np.mod(phases.astype(np.float64), 2 * np.pi) - np.pi), 1, mode="edge")
    along_x, along_y = beyond[1:-1, :-2] + beyond[1:-1, 2:], beyond[:-2, 1:-1] + beyond[2:, 1:-1]
    return np.asarray(shares[0] * along_x + shares[1] * along_y)


def of_decoded_neighbours(p: NDArray[np.floating], shares: tuple[float, float]) -> NDArray[np.float32]:
    """Phase that neighbours add to each symbol of a decoded page, radians [ny, nx]: to be taken off.

    Args:
        p: piston removed, [2, ny, nx]; its angle is the phase, its length the concentration.
        shares: shares along x and along y.
    """
    phase, added = np.arctan2(p[1], p[0]), np.zeros(p.shape[1:], np.float32)
    if any(shares):
        certainty = mean_resultant(np.hypot(p[0], p[1]))
        for _ in range(2):  # what is added takes some phases past the end of a turn
            added = of_neighbours(phase - added, shares, certainty).astype(np.float32)
    return added
