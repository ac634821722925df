"""Planes, modes and cells of the device's waves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.device.lens_path import IDEAL, SeidelTerms

Complex = NDArray[np.complexfloating]

Real = NDArray[np.floating]

UNCOUPLED = 1.2 * np.pi, 0.8 * np.pi
"""Radians in a step by which modes fall apart that are not coupled, and that are fully coupled."""

_MODE_MARGIN = 1.04
"""Modes beyond the one that the page's edge excites: an edge of the facet spreads it."""


@dataclass(frozen=True)
class WaveGeometry:
    """Everything that the field depends on between SLM and cameras. Metres and radians."""

    wavelength_m: float
    focal_length_m: float
    pipe_length_m: float
    pipe_width_m: float
    """Distance of the walls along x, the geometric mean over both facets."""
    refractive_index: float
    pipe_angle: float = 0.0
    """Shear t of the cross-section."""
    pipe_roll: float = 0.0
    """Rotation of the pipe about the optical axis, from x towards y, against page and cameras."""
    pipe_height_relative: float = 0.0
    """Distance of the walls along y' over that along x, less one."""
    pipe_taper: float = 0.0
    """Both distances at the exit over those at the entrance, less one; `taper_defocus` belongs to the lenses' paths."""
    lens_path: SeidelTerms = IDEAL
    """Path of the first lens, the modulator's axial place included."""
    camera_path: SeidelTerms = IDEAL
    """Path of the second lens, the cameras' axial place included, as a lens from camera plane to facet (`mirrored`)."""

    @property
    def wave_number(self) -> float:
        """Free-space k, rad/m."""
        return 2 * np.pi / self.wavelength_m

    def facet_sides_m(self, *, second: bool = False) -> tuple[float, float]:
        """Sides along (y', x) of the entrance facet, or of the `second` one, the exit."""
        width = self.pipe_width_m * (1 + self.pipe_taper) ** (0.5 if second else -0.5)
        return width * (1 + self.pipe_height_relative), width


def taper_defocus(wave_number: float, length_m: float, taper: float) -> tuple[float, float]:
    """Return the curvature that a taper of the pipe adds: factors of R^2 at entrance and exit, rad/m^2.

    Modes of widening walls are those of even ones under exp(i k w'/(2 w) R^2), w' being the growth of the width per
    length. This is exact for paraxial light and walls that run straight.

    Args:
        wave_number: k in the glass, rad/m.
        length_m: length of the pipe.
        taper: see `WaveGeometry`.
    """
    bend = wave_number * taper / (2 * length_m)
    return -bend, bend / (1 + taper)


def modes_for(half_extent_m: float, geometry: WaveGeometry, margin: float) -> int:
    """Cells per pipe axis such that the sine modes reach the plane wave of an SLM point at `half_extent_m`."""
    cells = 2 * half_extent_m * geometry.pipe_width_m / (geometry.wavelength_m * geometry.focal_length_m)
    return int(np.ceil(cells * margin))


def cells_for(
    geometry: WaveGeometry, page_x_m: Real, page_y_m: Real, seen_x_m: float, seen_y_m: float
) -> tuple[int, int]:
    """Cells of the pipe along (y', x) such that its modes carry all of the page's light.

    Reflections between walls that are sheared by t turn the light by 2 t, a roll of the pipe turns it once more: the
    page's long edge then reaches further along the short one. And since the facet is sampled, the camera plane shows
    the page's image again, one period (2 modes' reach) further; the period must keep that out of what is looked at.

    Args:
        geometry: the device, with its true or fitted angle and roll.
        page_x_m, page_y_m: SLM sample positions against the optical axis, shift of the page included, [nx] and [ny].
        seen_x_m, seen_y_m: half extents of what is looked at on the camera plane.
    """
    reach_x, reach_y = float(np.abs(page_x_m).max()), float(np.abs(page_y_m).max())
    shear = abs(geometry.pipe_roll) + 2 * abs(geometry.pipe_angle)
    wider = (1 + abs(geometry.pipe_taper)) ** 0.5
    higher = wider * (1 + geometry.pipe_height_relative)

    def cells(reach: float, seen: float, larger: float) -> int:
        return max(
            modes_for(reach, geometry, _MODE_MARGIN * larger), modes_for((reach + seen) / 2, geometry, margin=larger)
        )

    return cells(reach_y + shear * reach_x, seen_y_m, higher), cells(reach_x + shear * reach_y, seen_x_m, wider)


def sine_matrix(cells: int) -> Real:
    """Orthonormal DST-I matrix [cells-1, cells-1]: mode m = row + 1 sampled at j/cells, j = column + 1."""
    index = np.arange(1, cells)
    return np.asarray(np.sqrt(2 / cells) * np.sin(np.pi * np.outer(index, index) / cells))


def facet_axis(cells: int, width: float) -> Real:
    """Sample positions on one axis of a facet, metres, [cells - 1]."""
    return np.asarray((np.arange(1, cells) / cells - 0.5) * width)


def mode_detuning(geometry: WaveGeometry, rows: Real, columns: Real) -> Real:
    """kz - nk of the square pipe's sine modes, rad/m.

    Args:
        geometry: the device; neither shear nor taper count.
        rows, columns: mode numbers along y' and x, arrays that broadcast.

    Raises:
        ValueError: a mode that does not propagate.
    """
    nk = geometry.refractive_index * geometry.wave_number
    higher = 1 + geometry.pipe_height_relative
    transverse = (np.pi / geometry.pipe_width_m) ** 2 * ((rows / higher) ** 2 + columns**2)
    if transverse.max() >= nk**2:
        raise ValueError(f"modes: got transverse wave number {np.sqrt(transverse.max()):.3g}, wanted below {nk:.3g}")
    return np.asarray(detuning(nk, transverse, np.sqrt))


def detuning(nk: Any, transverse: Any, sqrt: Callable[[Any], Any]) -> Any:
    """kz - nk of a wave with a squared transverse wave number, without cancellation; in numpy or torch, by its sqrt."""
    return -transverse / (sqrt(nk * nk - transverse) + nk)


class Couplings(NamedTuple):
    """Factors on k/f in a lens's phase between a point (x, y) of its plane and one (X, Y') of the oblique facet."""

    x_to_x: Any
    y_to_x: Any
    y_to_y: Any
    x_to_y: Any


def couplings(geometry: WaveGeometry, xp: Any = np) -> Couplings:
    """The couplings for a pipe's shear and roll; `xp` is numpy, or torch for a geometry of tensors."""
    t, roll = geometry.pipe_angle, geometry.pipe_roll
    sin, cos, tan = xp.sin(roll), xp.cos(roll), xp.tan(t)
    return Couplings(cos + tan * sin, sin - tan * cos, cos / xp.cos(t), -sin / xp.cos(t))


def on_facet(factors: Couplings, across: Any, up: Any) -> tuple[Any, Any]:
    """A point (X, Y') of the oblique facet as Cartesian coordinates along the lens's x and y."""
    return factors.x_to_x * across + factors.x_to_y * up, factors.y_to_x * across + factors.y_to_y * up


def highest_frequencies(geometry: WaveGeometry, path: SeidelTerms, x_m: Real, y_m: Real) -> tuple[float, float]:
    """Bounds on the frequencies along x and y that the exit facet's light has on a lens's plane, cycles a metre.

    Args:
        geometry: the device.
        path: path of that lens.
        x_m, y_m: points of the plane that are used.
    """
    (height, width), factors = geometry.facet_sides_m(second=True), np.abs(couplings(geometry))
    furthest = on_facet(Couplings(*factors), width / 2, height / 2)
    corner = np.abs(x_m).max(), np.abs(y_m).max()
    # each term as if it added to the others at the corner of both planes
    slopes = SeidelTerms(*np.abs(path)).slope_on_field(*corner, *furthest)
    per_metre = geometry.wave_number / geometry.focal_length_m
    along_x, along_y = (
        float(per_metre * place + slope) / (2 * np.pi) for place, slope in zip(furthest, slopes, strict=True)
    )
    return along_x, along_y
