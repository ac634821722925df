"""The lenses: from a plane to the pipe's facet and back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lightpage.device.lens_path import IDEAL
from lightpage.waves.geometry import Complex, Real, WaveGeometry, couplings, facet_axis, on_facet, sine_matrix
from lightpage.waves.low_rank import Expansion, Interpolation, Phase

_TOLERANCE = 1e-7
"""Singular values of an ideal lens's expansion are dropped below this share of the largest: less than rounding."""

_TOLERANCE_WITH_PATH = 1e-3
"""The same for a real lens, a field error of about 0.002; 1e-5 would take twice the terms, a hundred at full size."""


def lens_kernel(geometry: WaveGeometry, rows: Real, columns: Real) -> Complex:
    """exp(-i k/f row column): what a 2f lens does along one axis."""
    return np.asarray(np.exp(-1j * geometry.wave_number / geometry.focal_length_m * np.outer(rows, columns)))


def entrance_window(
    geometry: WaveGeometry, facet_x_m: Any, facet_y_m: Any, envelope_m: float, blur_m: float = 0.0, xp: Any = np
) -> Any:
    """Transmission of the SLM's pixel shape and blur at the entrance facet, [fy, fx].

    Args:
        geometry: the device.
        facet_x_m, facet_y_m: sample positions along the facet's axes, [fx] and [fy].
        envelope_m, blur_m: see `WaveChannel`.
        xp: as for `couplings`.
    """
    t = geometry.pipe_angle
    per_metre = 1 / (geometry.wavelength_m * geometry.focal_length_m)
    fy = (facet_y_m[:, None] / xp.cos(t) - facet_x_m[None, :] * xp.tan(t)) * per_metre
    fx = facet_x_m[None, :] * per_metre
    pixel = xp.sinc(fx * envelope_m) * xp.sinc(fy * envelope_m)
    return pixel * xp.exp(-2 * (np.pi * blur_m) ** 2 * (fx**2 + fy**2))


class FourierLens:
    """A 2f lens between a Cartesian plane (SLM or camera) and the oblique sample grid on a pipe facet.

    The kernel exp(-i k/f (x X + y Y)) is a product of four couplings of (x, y) with the facet's (X, Y'). Three of them
    factor into matrix products; the fourth, x with Y', is there only when the pipe is rolled. It and the path of a real
    lens beyond the ideal one vary by a few radians and are expanded in few terms.

    Args:
        geometry: the device.
        x_m, y_m: sample positions on the plane, uniform, [nx] and [ny].
        cells: sample intervals of the pipe along (y', x).
        second: whether this is the second lens, between cameras and exit.

    Attributes:
        x_to_x, y_and_x, y_to_y: the three couplings that factor, [nx, fx], [ny, fx] and [fy, ny].
        terms: of the rest, between plane and facet.
        on_plane: phasor of the lens's path that depends on the plane alone, [ny, nx], or one.
    """

    def __init__(
        self, geometry: WaveGeometry, x_m: Real, y_m: Real, cells: tuple[int, int], *, second: bool = False
    ) -> None:
        w = geometry.pipe_width_m
        facet_y, facet_x = (facet_axis(count, w) for count in cells)
        factors = couplings(geometry)
        path = geometry.lens_path.mirrored() if second else geometry.lens_path

        def kernel(factor: float, rows: Real, columns: Real) -> Complex:
            return lens_kernel(geometry, factor * rows, columns)

        area = (x_m[1] - x_m[0]) * (y_m[1] - y_m[0]) * (w / cells[0]) * (w / cells[1]) / np.cos(geometry.pipe_angle)
        unitary = np.sqrt(area) / (geometry.wavelength_m * geometry.focal_length_m)
        self.x_to_x = (unitary * kernel(factors.x_to_x, x_m, facet_x)).astype(np.complex64)
        self.y_and_x = kernel(factors.y_to_x, y_m, facet_x).astype(np.complex64)
        self.y_to_y = kernel(factors.y_to_y, facet_y, y_m).astype(np.complex64)
        tolerance = _TOLERANCE if path == IDEAL else _TOLERANCE_WITH_PATH
        self._geometry, self._path = geometry, path
        self._planes = (x_m, y_m), (facet_x, facet_y)
        self.terms = Expansion.of(self._rest(geometry), *self._planes, tolerance)
        self.on_plane: Complex = np.ones((1, 1), np.complex64)
        if path != IDEAL:
            self.on_plane = np.exp(1j * path.of_field(x_m[None, :], y_m[:, None])).astype(np.complex64)

    def interpolation(self, roll_margin: float, tolerance: float) -> Interpolation:
        """Of what does not factor, for rolls up to so many radians to either side of the geometry's."""
        rolls = (self._geometry.pipe_roll + share * roll_margin for share in (-1, 0, 1))
        phases = [self._rest(replace(self._geometry, pipe_roll=roll)) for roll in rolls]
        return Interpolation.of(phases, *self._planes, tolerance)

    def _rest(self, geometry: WaveGeometry) -> Phase:
        """What does not factor, of a geometry with the same lenses."""
        factors, path = couplings(geometry), self._path

        def phase(x: Real, y: Real, across: Real, up: Real) -> Real:
            rolled = -geometry.wave_number / geometry.focal_length_m * factors.x_to_y * x * up
            return np.asarray(rolled + path.of_both(x, y, *on_facet(factors, across, up)))

        return phase

    def to_facet(self, field: Complex) -> Complex:
        """Field on the plane [ny, nx] to the facet's grid [cells_y - 1, cells_x - 1]."""
        field = field.astype(np.complex64) * self.on_plane
        total: Complex | None = None
        for at_plane, at_facet in self.terms.terms():
            term = self.y_to_y @ (((field * at_plane) @ self.x_to_x) * self.y_and_x)
            term *= at_facet
            total = term if total is None else total + term
        assert total is not None
        return total

    def to_plane(self, field: Complex) -> Complex:
        """The adjoint of `to_facet`: a field on the facet's grid to the plane [ny, nx], kernel exp(+i ...)."""
        field = field.astype(np.complex64)
        total: Complex | None = None
        for at_plane, at_facet in self.terms.terms():
            inner = (self.y_to_y.conj().T @ (field * at_facet.conj())) * self.y_and_x.conj()
            term = (inner @ self.x_to_x.conj().T) * at_plane.conj()
            total = term if total is None else total + term
        assert total is not None
        return np.asarray(total * self.on_plane.conj())


def modes_of_plane(geometry: WaveGeometry, plane_m: Real, cells: int) -> Complex:
    """One axis of a field on a lens's outer plane to the square pipe's sine modes, by a matrix [cells - 1, samples].

    Mode m = row + 1. The pipe neither sheared nor rolled; the matrix's adjoint takes modes back to the plane.

    Args:
        geometry: the device.
        plane_m: sample positions, uniform, metres, [samples].
        cells: sample intervals of the pipe on this axis.
    """
    width = geometry.pipe_width_m
    unitary = np.sqrt((plane_m[1] - plane_m[0]) * width / cells / (geometry.wavelength_m * geometry.focal_length_m))
    return np.asarray(unitary * sine_matrix(cells) @ lens_kernel(geometry, facet_axis(cells, width), plane_m))
