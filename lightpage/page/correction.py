"""Correction of a decoded page by what its pilots and its levels show, from the network's answer to the decision.

`PhaseRefit` finds a smooth phase error without knowing the data.

What a page's drift, its modulator's warping or a geometry slightly off leave behind varies slowly over the page and
jumps where the light meets another number of walls. So the error is a plane in each wall zone. Which level a symbol is,
is not known; expectation maximisation takes its posterior instead: the mean distance to the levels, weighted by it, is
fitted, and again with what is left. Pilots are known. Where symbols are too uncertain to tell one level from the next,
the distances average out and nothing is taken off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.page.crosstalk import of_decoded_neighbours
from lightpage.page.levels import Levels
from lightpage.page.pilots import PilotReading, Pilots, read_pilots, remove_piston, stroke_error

_Floats = NDArray[np.floating]

ROUNDS = 5
"""Of expectation maximisation. More gain nothing where levels are told apart, and fit noise where they are not:
`python -m analysis.codec.refit` prints it."""

_NEIGHBOURS = 4
"""Levels on either side of the nearest one that may be the true one."""

_MOST_SYMBOLS = 20_000
"""A dozen coefficients are known well enough from so many."""

_CAP = 1e5
"""Largest concentration that counts as such."""

_PRIOR_RAD = 0.05
"""Standard deviation of every coefficient beforehand. A zone of many symbols does not feel it; few are held back."""


class PhaseRefit:
    """The refit of one device's pages.

    Args:
        page_shape: (ny, nx).
        positions: exit centroid of each symbol's light over the pipe's width, [2, ny, nx]; None where that is unknown,
            and the page is one zone.
    """

    def __init__(self, page_shape: tuple[int, int], positions: _Floats | None = None) -> None:
        ny, nx = page_shape
        y, x = np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")
        walls = np.zeros((2, ny, nx)) if positions is None else np.rint(np.abs(positions)) % 2
        _, zones = np.unique((walls[0] + 2 * walls[1]).ravel(), return_inverse=True)
        self._planes = np.stack([np.ones(ny * nx), x.ravel(), y.ravel()])
        self._shape, self._zones = page_shape, zones
        taken = np.arange(0, ny * nx, -(-ny * nx // _MOST_SYMBOLS))
        self._taken = taken[np.argsort(zones[taken], kind="stable")]  # zone behind zone
        own = zones[self._taken]
        self._starts = np.flatnonzero(np.diff(own, prepend=-1))
        planes = self._planes[:, self._taken]
        self._products = planes[:, None] * planes
        self._filled, self._sizes = own[self._starts], np.diff(self._starts, append=len(own))

    def error(
        self, phase: _Floats, concentration: _Floats, levels: int | Levels, pilots: Pilots, rounds: int = ROUNDS
    ) -> NDArray[np.float32]:
        """The smooth error of a page's phases, radians [ny, nx]: to be taken off.

        Args:
            phase: radians, piston removed, [ny, nx].
            concentration: von Mises kappa, [ny, nx].
            levels: M, or uneven levels.
            pilots: the known symbols of this page.
            rounds: number of rounds of expectation maximisation.
        """
        known = np.full(self._shape, np.nan)
        known[pilots.mask] = pilots.phases
        truth = known.ravel()[self._taken]
        is_known = ~np.isnan(truth)
        mu = np.asarray(phase, np.float64).ravel()[self._taken]
        kappa = np.minimum(np.asarray(concentration, np.float64).ravel()[self._taken], _CAP)
        planes = self._planes[:, self._taken]
        # sums and no matrix products: those wake threads, which go on looking for work on cores that others need
        normal = np.moveaxis(self._sums(self._products * kappa), -1, 0) + np.eye(len(planes)) / _PRIOR_RAD**2
        levels, coefficients = Levels.of(levels), np.zeros((len(self._filled), len(planes)))
        for _ in range(rounds):
            left = mu - _at(planes, np.repeat(coefficients.T, self._sizes, axis=1))
            distance = _mean_distance(left, kappa, levels)
            distance[is_known] = wrapped(left[is_known] - truth[is_known])
            gradient = self._sums(planes * (kappa * distance)).T - coefficients / _PRIOR_RAD**2
            coefficients = coefficients + np.linalg.solve(normal, gradient[..., None])[..., 0]
        of_zones = np.zeros((self._zones.max() + 1, len(planes)))
        of_zones[self._filled] = coefficients
        return np.asarray(_at(self._planes, of_zones.T[:, self._zones]).reshape(self._shape), np.float32)

    def _sums(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Over the symbols taken of each zone that has any: [..., symbols] to [..., zones]."""
        return np.asarray(np.add.reduceat(values, self._starts, axis=-1))


def _at(planes: NDArray[np.float64], coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what each symbol's coefficients [3, symbols] make of the planes [3, symbols] there."""
    first, *others = planes * coefficients
    return np.asarray(sum(others, first))


def _mean_distance(mu: NDArray[np.float64], kappa: NDArray[np.float64], levels: Levels) -> NDArray[np.float64]:
    """Distance of each phase to the levels about it, the mean over their posterior, radians [symbols]."""
    few = min(_NEIGHBOURS, (levels.count - 1) // 2)
    neighbours = np.arange(-few, few + 1)  # in rows: sums take whole arrays
    places, nearest = levels.around(mu)
    if levels.is_nominal:
        offsets = np.float32(2 * np.pi / levels.count) * neighbours.astype(np.float32)[:, None]
    else:
        offsets = levels.gaps(neighbours).astype(np.float32)[:, places]
    away = (mu - nearest).astype(np.float32)
    near, k = np.cos(away), kappa.astype(np.float32)
    # cos(away - offset) - cos(away), without a cosine each
    weight = np.exp(np.sin(offsets) * (k * np.sin(away)) - 2 * np.sin(0.5 * offsets) ** 2 * (k * near))
    return np.asarray(away - (offsets * weight).sum(axis=0) / weight.sum(axis=0), np.float64)


def wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angles within -pi to pi."""
    return np.asarray(angle - 2 * np.pi * np.rint(angle / (2 * np.pi)))


@dataclass(frozen=True)
class Corrected:
    """A decoded page whose errors are taken off.

    Attributes:
        phase: radians [ny, nx], within half a turn.
        concentration: von Mises kappa as far as the pilots bear it out, [ny, nx].
        error: smooth error and flicker that were taken off, radians [ny, nx]; piston and crosstalk were too.
        reading: evidence of the pilots.
        stroke_relative: error of the modulator's stroke; NaN where pilots show nothing of it.
    """

    phase: NDArray[np.float32]
    concentration: NDArray[np.float32]
    error: NDArray[np.float32]
    reading: PilotReading
    stroke_relative: float


def corrected(
    phase: NDArray[np.floating], concentration: NDArray[np.floating], levels: Levels, pilots: Pilots, refit: PhaseRefit
) -> Corrected:
    """Take piston, crosstalk, smooth error and flicker off a page.

    Args:
        phase: decoded, radians [ny, nx].
        concentration: its von Mises kappa as the network claims it, [ny, nx].
        levels: levels of the page.
        pilots: the known symbols of the page.
        refit: refit of the device's pages.
    """
    reading = read_pilots(_vectors(phase, concentration), pilots)
    if any(levels.crosstalk):
        still = _vectors(remove_piston(phase, reading.piston.angle_rad), concentration)
        phase = remove_piston(phase, of_decoded_neighbours(still, levels.crosstalk))
        reading = read_pilots(_vectors(phase, concentration), pilots)
    phase = remove_piston(phase, reading.piston.angle_rad)
    smooth = refit.error(phase, concentration, levels, pilots)
    sure = np.asarray(concentration * np.float32(reading.trust), np.float32)
    stroke = stroke_error(phase - smooth, sure, reading.sound)
    error = smooth + stroke.of_phases(phase)
    return Corrected(remove_piston(phase, error), sure, error, reading, stroke.relative)


def _vectors(phase: NDArray[np.floating], concentration: NDArray[np.floating]) -> NDArray[np.floating]:
    """Vectors p, [2, ny, nx], of such angles and lengths."""
    return np.asarray(concentration * np.stack([np.cos(phase), np.sin(phase)]))
