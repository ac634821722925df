"""The lenses: from a plane to the pipe's facet and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from itertools import starmap
from operator import add
from typing import Any

import numpy as np

from lightpage.device.lens_path import IDEAL, SeidelTerms
from lightpage.waves.arrays import NUMPY, Arrays
from lightpage.waves.geometry import (
    Complex,
    Couplings,
    Real,
    WaveGeometry,
    couplings,
    facet_axis,
    on_facet,
    sine_matrix,
)
from lightpage.waves.low_rank import Expansion

_TOLERANCE = 1e-7
"""Singular values of an ideal lens's expansion are dropped below this share of the largest: less than rounding."""

TOLERANCE_WITH_PATH = 1e-3
"""Tolerance for a real lens, a field error of about 0.002; 1e-5 would take twice the terms."""


def lens_kernel(geometry: WaveGeometry, rows: Real, columns: Real) -> Complex:
    """exp(-i k/f row column): what a 2f lens does along one axis."""
    return np.asarray(np.exp(-1j * geometry.wave_number / geometry.focal_length_m * np.outer(rows, columns)))


def entrance_window(
    geometry: WaveGeometry, facet_x_m: Any, facet_y_m: Any, envelope_m: float, blur_m2: Any = 0.0, xp: Any = np
) -> Any:
    """Transmission of the SLM's pixel shape and blur at the entrance facet, [fy, fx].

    Args:
        geometry: the device.
        facet_x_m, facet_y_m: sample positions along the facet's axes, [fx] and [fy].
        envelope_m, blur_m2: see `WaveChannel`; the blur may be a tensor.
        xp: see `couplings`.
    """
    per_metre = 1 / (geometry.wavelength_m * geometry.focal_length_m)
    along = on_facet(couplings(geometry, xp), facet_x_m, facet_y_m[:, None])
    fx, fy = (place * per_metre for place in along)
    pixel = xp.sinc(fx * envelope_m) * xp.sinc(fy * envelope_m)
    return pixel * xp.exp(-2 * np.pi**2 * blur_m2 * (fx**2 + fy**2))


@dataclass(frozen=True)
class LensPath:
    """Phase of a lens between (x, y) on its plane and (X, Y') on the facet, by parts. Radians, in numpy or torch.

    Terms in the facet's point alone, in (x, X), (y, X) or (y, Y') are merged into the factors of the couplings. The
    `rest` needs an expansion of its own, with half as many terms as the whole phase. Places are relative to (a, b).

    Args:
        geometry: the device.
        path: beyond an ideal lens's.
        factors: `couplings` of the geometry.
    """

    geometry: WaveGeometry
    path: SeidelTerms
    factors: Couplings

    @property
    def per_metre(self) -> Any:
        """k/f, rad/m^2."""
        return self.geometry.wave_number / self.geometry.focal_length_m

    def on_facet(self, across: Any, up: Any) -> Any:
        """Return the part of the path's phase that depends on the facet's point alone, radians."""
        return self.path.of_both(0.0, 0.0, *on_facet(self.factors, across, up))

    def beyond(self, x: Any, y: Any, across: Any, up: Any, a: Any = 0.0, b: Any = 0.0) -> Any:
        """Return the path's phase at (x, y) less that at (a, b), radians."""
        if not self.path.couples:
            return 0.0 * (a + b + x + y + across + up)
        return self.path.of_step(a, b, x, y, *on_facet(self.factors, across, up))

    def phase(self, x: Any, y: Any, across: Any, up: Any, a: Any = 0.0, b: Any = 0.0) -> Any:
        """Return `beyond` of the whole lens, with the ideal lens's phase, radians."""
        along, upward = on_facet(self.factors, across, up)
        return self.beyond(x, y, across, up, a, b) - self.per_metre * (x * along + y * upward)

    def rest(self, x: Any, y: Any, across: Any, up: Any, a: Any = 0.0, b: Any = 0.0) -> Any:
        """Return the phase, radians, that no factor of the couplings takes in, the roll's term in (x, Y') included."""
        rolled = -self.per_metre * self.factors.x_to_y * x * up
        to_x, to_both = self.beyond(x, 0.0, across, 0.0, a, b), self.beyond(0.0, y, across, 0.0, a, b)
        to_y = self.beyond(0.0, y, 0.0, up, a, b)
        return rolled + self.beyond(x, y, across, up, a, b) - to_x - to_both - to_y


class FourierLens:
    """A 2f lens between a Cartesian plane (SLM or camera) and the oblique sample grid on a pipe facet.

    The kernel exp(-i k/f (x X + y Y)) is a product of four couplings of (x, y) with the facet's (X, Y'). Three of them
    factor into matrix products, and so does much of a real lens's path (`LensPath`). The rest varies by a few radians
    and is expanded in few terms.

    Args:
        geometry: the device.
        x_m, y_m: sample positions on the plane, uniform, [nx] and [ny].
        cells: sample intervals of the pipe along (y', x).
        second: whether this is the second lens, between cameras and exit.
        arrays: array library of the fields and the attributes.

    Attributes:
        x_to_x, y_and_x, y_to_y: the three couplings that factor, [nx, fx], [ny, fx] and [fy, ny].
        terms: terms of the rest, between plane and facet.
        on_plane, on_facet: phasors of the lens's path that depend on one of them alone, [ny, nx] and [fy, fx], or one.
    """

    def __init__(
        self,
        geometry: WaveGeometry,
        x_m: Real,
        y_m: Real,
        cells: tuple[int, int],
        *,
        second: bool = False,
        arrays: Arrays = NUMPY,
    ) -> None:
        height, width = geometry.facet_sides_m(second=second)
        facet_y, facet_x = facet_axis(cells[0], height), facet_axis(cells[1], width)
        factors = couplings(geometry)
        path = geometry.camera_path if second else geometry.lens_path

        def kernel(factor: float, rows: Real, columns: Real) -> Complex:
            return lens_kernel(geometry, factor * rows, columns)

        cell_y, cell_x = height / cells[0], width / cells[1]
        area = (x_m[1] - x_m[0]) * (y_m[1] - y_m[0]) * cell_y * cell_x / np.cos(geometry.pipe_angle)
        unitary = np.sqrt(area) / (geometry.wavelength_m * geometry.focal_length_m)
        self.x_to_x = (unitary * kernel(factors.x_to_x, x_m, facet_x)).astype(np.complex64)
        self.y_and_x = kernel(factors.y_to_x, y_m, facet_x).astype(np.complex64)
        self.y_to_y = kernel(factors.y_to_y, facet_y, y_m).astype(np.complex64)
        tolerance = TOLERANCE_WITH_PATH if path.couples else _TOLERANCE
        parts = LensPath(geometry, path, factors)
        beyond = parts.beyond
        self.terms = Expansion.of(parts.rest, (x_m, y_m), (facet_x, facet_y), tolerance)
        self.on_plane: Complex = np.ones((1, 1), np.complex64)
        self.on_facet: Complex = self.on_plane
        if path.couples:
            self.x_to_x *= _phasor(beyond(x_m[:, None], 0.0, facet_x, 0.0))
            self.y_and_x *= _phasor(beyond(0.0, y_m[:, None], facet_x, 0.0))
            self.y_to_y *= _phasor(beyond(0.0, y_m, 0.0, facet_y[:, None]))
            self.on_plane = _phasor(path.of_field(x_m, y_m[:, None]))
        if path != IDEAL:
            self.on_facet = _phasor(parts.on_facet(facet_x, facet_y[:, None]))
        self._arrays = arrays
        self.terms = self.terms if arrays.xp is np else self.terms.on(arrays)
        for name in ("x_to_x", "y_and_x", "y_to_y", "on_plane", "on_facet"):
            setattr(self, name, arrays.array(getattr(self, name)))

    def to_facet(self, field: Complex) -> Complex:
        """Field on the plane [ny, nx] to the facet's grid [cells_y - 1, cells_x - 1]."""
        field = self._arrays.complex64(field) * self.on_plane

        def term(at_plane: Complex, at_facet: Complex) -> Complex:
            product: Complex = self.y_to_y @ (((field * at_plane) @ self.x_to_x) * self.y_and_x)
            product *= at_facet
            return product

        light: Complex = self._sum(term) * self.on_facet
        return light

    def to_plane(self, field: Complex) -> Complex:
        """The adjoint of `to_facet`: a field on the facet's grid to the plane [ny, nx], kernel exp(+i ...)."""
        field = self._arrays.complex64(field) * self.on_facet.conj()

        def term(at_plane: Complex, at_facet: Complex) -> Complex:
            inner = (self.y_to_y.conj().T @ (field * at_facet.conj())) * self.y_and_x.conj()
            product: Complex = (inner @ self.x_to_x.conj().T) * at_plane.conj()
            return product

        light: Complex = self._sum(term) * self.on_plane.conj()
        return light

    def _sum(self, term: Callable[[Complex, Complex], Complex]) -> Complex:
        """Sum of what is made of each term's factors on plane and facet."""

        def some(which: slice) -> Complex:
            return reduce(add, starmap(term, self.terms.terms(which)))

        total: Complex = self._arrays.sum(some, len(self.terms.first))
        return total


def _phasor(phase: Real) -> Complex:
    return np.asarray(np.exp(1j * phase), np.complex64)


def modes_of_plane(geometry: WaveGeometry, plane_m: Real, cells: int) -> Complex:
    """Return the matrix from a lens's outer plane to the square pipe's sine modes on one axis, [cells - 1, samples].

    Mode m = row + 1. The pipe neither sheared nor rolled; the matrix's adjoint takes modes back to the plane.

    Args:
        geometry: the device.
        plane_m: sample positions, uniform, metres, [samples].
        cells: sample intervals of the pipe on this axis.
    """
    width = geometry.pipe_width_m
    unitary = np.sqrt((plane_m[1] - plane_m[0]) * width / cells / (geometry.wavelength_m * geometry.focal_length_m))
    return np.asarray(unitary * sine_matrix(cells) @ lens_kernel(geometry, facet_axis(cells, width), plane_m))
