"""Finds where a page's image lies on the cameras from its pilots: there their light adds up along all branches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.coherence import branch_shares
from lightpage.calibration.interfaces import BRANCHES, Twin
from lightpage.calibration.sampling_table import orientations, symbol_centres
from lightpage.device.profile import Profile
from lightpage.page.pilots import Pilots
from lightpage.waves.grid import field_grid, symbol_samples

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

REACH_PX = 12.0
"""Reach of the search from where the image is expected, camera pixels, along either axis."""

COARSE_PX = 2.0
"""Step of the coarse search, camera pixels. The light's correlation falls to half within 3: at most a fifth is lost."""

_COARSE_SAMPLES = 2
"""Samples per symbol and axis of the coarse search: the branches' phases hardly turn between two of them."""

_FINE_PX = (1.0, 0.4, 0.15)
"""Steps of the lattices of 3x3 shifts, each about the vertex of the one before, whose last vertex is the answer."""

FALSE_ALARMS = 1e-5
"""Probability that one search takes another page's light for this page's."""

FEWEST_SEARCHED = 4
"""Fewer agree by chance wherever they are looked at."""

_INDEPENDENT_PER_PX2 = 0.5
"""Independent trials per square pixel searched, twice what the field's correlation length of 5 pixels suggests, and
for the fine search."""


class FoundImage(NamedTuple):
    """Outcome of a search.

    Attributes:
        shift_px: (x, y) of the image against where the geometry puts it, camera pixels, mean over both cameras.
        significance: power of the pilots' coherent sum over that of their incoherent sum; their number where all
            agree, about 1 where they are unrelated.
        needed: significance that unrelated light reaches in one of 1 / `FALSE_ALARMS` searches.
    """

    shift_px: Real
    significance: float
    needed: float

    @property
    def found(self) -> bool:
        """Return whether the pilots confirm that the image lies at this place."""
        return self.significance >= self.needed


@dataclass(frozen=True)
class _Template:
    """The light of the pilots that is looked for.

    Attributes:
        places: places at which the field is sampled, grid samples (column, row), [B, N, S, 2].
        conjugate: factors that remove the path's and the symbol's phase, over the branch's share, [B, N, S].
    """

    places: Real
    conjugate: Complex


class ImageSearch:
    """Looks for pages of one device.

    Args:
        twin, parameters: the device as it was calibrated.
        profile: the nominal device.
    """

    def __init__(self, twin: Twin, parameters: Real, profile: Profile) -> None:
        self._twin, self._parameters, self._profile = twin, parameters, profile
        grid = field_grid(profile)
        self._origin, self._pitch_m = np.array([grid.x_m[0], grid.y_m[0]]), grid.pitch_m
        self._to_grid = self._samples_per_pixel()

    def find(self, field: Complex, pilots: Pilots, around_px: Real | None = None) -> FoundImage:
        """Find the image of a page.

        Args:
            field: recovered with the registration of the calibration, complex [Gy, Gx].
            pilots: known symbols of this page. Their piston need not be known.
            around_px: shifts [K, 2], (x, y) in camera pixels; all within `REACH_PX` of any of them is searched. By
                default the image is looked for where the calibration saw it.
        """
        around = np.zeros((1, 2)) if around_px is None else np.asarray(around_px, np.float64)
        # on one lattice, so that windows which overlap are searched once
        trials = np.unique(_lattice(np.rint(around / COARSE_PX) * COARSE_PX, REACH_PX, COARSE_PX), axis=0)
        scores = self._scores(field, self._template(pilots, _COARSE_SAMPLES), trials, order=1)
        best = trials[int(np.argmax(scores))]
        smooth = scipy.ndimage.spline_filter(field.real, 3) + 1j * scipy.ndimage.spline_filter(field.imag, 3)
        template, score = self._template(pilots, symbol_samples(self._profile)), 0.0
        for step in _FINE_PX:
            near = _lattice(best[None], step, step)
            scores = self._scores(smooth, template, near, order=3)
            score = float(scores.max())
            best = best + step * _vertex(scores.reshape(3, 3))
        return FoundImage(best, score, needed_significance(len(pilots.phases), len(trials) * COARSE_PX**2))

    def _samples_per_pixel(self) -> Real:
        """Grid samples (x, y) for a camera pixel's way along x and along y, in the mean of both cameras, [2, 2]."""
        places = np.array([[0.0, 0.0], [self._pitch_m, 0.0], [0.0, self._pitch_m]])
        pixels = self._twin.pixels(self._parameters, places)
        linear = np.swapaxes(pixels[:, 1:] - pixels[:, :1], 1, 2)
        upright = np.swapaxes(orientations(linear), 1, 2) @ linear
        return np.asarray(np.linalg.inv(upright.mean(axis=0)))

    def _template(self, pilots: Pilots, samples: int) -> _Template:
        """Trace the pilots, `samples` points per symbol and axis."""
        profile = self._profile
        centres = symbol_centres(profile)[pilots.mask.ravel()]
        steps = ((np.arange(samples) + 0.5) / samples - 0.5) * profile.symbol_pitch_m
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        points = (centres[:, None] + offsets).reshape(-1, 2)
        rays = self._twin.trace(self._parameters, points, np.repeat(centres, len(offsets), axis=0))
        shape = (len(BRANCHES), len(centres), len(offsets))
        middles = rays.positions.reshape(*shape[1:], 2).mean(axis=1)
        shares = branch_shares(middles, BRANCHES)
        phases = rays.phases.reshape(shape) + pilots.phases[:, None]
        places = (rays.places.reshape(*shape, 2) - self._origin) / self._pitch_m
        return _Template(places, shares[..., None] * np.exp(-1j * phases))

    def _scores(self, field: Complex, template: _Template, shifts_px: Real, order: Literal[1, 3]) -> Real:
        """Significance of every shift [K]; `field` has been through a spline filter where `order` is 3."""
        found = []
        for shift in shifts_px @ self._to_grid.T:
            column, row = np.moveaxis(template.places + shift, -1, 0)
            at = [row.ravel(), column.ravel()]
            real, imaginary = (
                scipy.ndimage.map_coordinates(part, at, order=order, prefilter=False)
                for part in (field.real, field.imag)
            )
            light = (real + 1j * imaginary).reshape(row.shape)
            by_pilot = np.sum(light * template.conjugate, axis=(0, 2))
            found.append(abs(by_pilot.sum()) ** 2 / max(float(np.sum(np.abs(by_pilot) ** 2)), 1e-30))
        return np.array(found)


def needed_significance(pilots: int, area_px2: float = (2 * REACH_PX) ** 2) -> float:
    """Significance that unrelated light reaches once in 1 / `FALSE_ALARMS` searches of an area, square camera pixels.

    The sum of n unrelated phasors with normally distributed parts has |sum|^2 / sum | |^2 / n distributed as
    Beta(1, n - 1); independent trials multiply.
    """
    if pilots < FEWEST_SEARCHED:
        return float("inf")
    trials = area_px2 * _INDEPENDENT_PER_PX2
    return float(pilots * (1 - (FALSE_ALARMS / trials) ** (1 / (pilots - 1))))


def _lattice(around: Real, reach: float, step: float) -> Real:
    """Shifts [K, 2] on a square lattice that reaches `reach` from every one of `around`."""
    side = int(np.ceil(reach / step))
    axis = np.arange(-side, side + 1) * step
    square = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return np.asarray((around[:, None] + square).reshape(-1, 2))


def _vertex(scores: Real) -> Real:
    """Return the vertex (x, y) of a quadratic fitted to 3x3 scores [y, x], in steps from the middle, within +-1."""
    y, x = (axis.ravel() for axis in np.mgrid[-1:2, -1:2])
    terms = np.stack([np.ones(9), x, y, x * x, x * y, y * y], axis=1)
    _, slope_x, slope_y, xx, xy, yy = np.linalg.lstsq(terms, scores.ravel(), rcond=None)[0]
    curvature = np.array([[2 * xx, xy], [xy, 2 * yy]])
    if np.linalg.eigvalsh(curvature).max() >= 0:
        row, column = np.unravel_index(int(np.argmax(scores)), scores.shape)
        return np.array([column - 1.0, row - 1.0])
    return np.asarray(np.clip(-np.linalg.solve(curvature, [slope_x, slope_y]), -1, 1))
