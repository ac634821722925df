"""Scalar wave optics of the device: lens, light-pipe, lens, on sampled planes, forward and adjoint.

Conventions: time dependence exp(-i omega t), so a wave travels as exp(+i kz z). The pipe's walls are x = +-w/2 and
y' = +-w/2 with y' = x sin t + y cos t, and the field vanishes on them. The common factor exp(i n k L) is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.device.lens_path import IDEAL, SeidelTerms
from lightpage.waves.low_rank import Expansion, Interpolation, Phase
from lightpage.waves.sinc_interpolation import interpolation, sparse_axis

Complex = NDArray[np.complexfloating]
Real = NDArray[np.floating]

_TOLERANCE = 1e-7
"""Singular values of an ideal lens's expansion are dropped below this share of the largest: less than rounding."""

_TOLERANCE_WITH_PATH = 1e-3
"""The same for a real lens, a field error of about 0.002; 1e-5 would take twice the terms, a hundred at full size."""

_UNCOUPLED = 1.2 * np.pi, 0.8 * np.pi
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
    refractive_index: float
    pipe_angle: float = 0.0
    """Shear t of the cross-section."""
    pipe_roll: float = 0.0
    """Rotation of the pipe about the optical axis, from x towards y, against page and cameras."""
    lens_path: SeidelTerms = IDEAL
    """Of the first lens; the second one is its mirror image."""

    @property
    def wave_number(self) -> float:
        """Free-space k, rad/m."""
        return 2 * np.pi / self.wavelength_m


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

    def cells(reach: float, seen: float) -> int:
        return max(modes_for(reach, geometry, _MODE_MARGIN), modes_for((reach + seen) / 2, geometry, margin=1))

    return cells(reach_y + shear * reach_x, seen_y_m), cells(reach_x + shear * reach_y, seen_x_m)


def sine_matrix(cells: int) -> Real:
    """Orthonormal DST-I matrix [cells-1, cells-1]: mode m = row + 1 sampled at j/cells, j = column + 1."""
    index = np.arange(1, cells)
    return np.asarray(np.sqrt(2 / cells) * np.sin(np.pi * np.outer(index, index) / cells))


def _facet(cells: int, width: float) -> Real:
    """Sample positions on one axis of a facet, metres, [cells - 1]."""
    return np.asarray((np.arange(1, cells) / cells - 0.5) * width)


def _lens_kernel(geometry: WaveGeometry, rows: Real, columns: Real) -> Complex:
    """exp(-i k/f row column): what a 2f lens does along one axis."""
    return np.asarray(np.exp(-1j * geometry.wave_number / geometry.focal_length_m * np.outer(rows, columns)))


def mode_detuning(geometry: WaveGeometry, rows: Real, columns: Real) -> Real:
    """kz - nk of the square pipe's sine modes, rad/m.

    Args:
        geometry: the device; its shear does not count.
        rows, columns: mode numbers along y' and x, arrays that broadcast.

    Raises:
        ValueError: a mode that does not propagate.
    """
    nk = geometry.refractive_index * geometry.wave_number
    transverse = (np.pi / geometry.pipe_width_m) ** 2 * (rows**2 + columns**2)
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
    """A point (X, Y') of the oblique facet as Cartesian coordinates of the lens's plane."""
    return factors.x_to_x * across + factors.x_to_y * up, factors.y_to_x * across + factors.y_to_y * up


def highest_frequencies(geometry: WaveGeometry, path: SeidelTerms, x_m: Real, y_m: Real) -> tuple[float, float]:
    """Bounds on the frequencies along x and y that a facet's light has on a lens's plane, cycles a metre.

    Args:
        geometry: the device.
        path: of that lens.
        x_m, y_m: what is looked at of the plane.
    """
    edge, factors = geometry.pipe_width_m / 2, np.abs(couplings(geometry))
    furthest = on_facet(Couplings(*factors), edge, edge)
    corner = np.abs(x_m).max(), np.abs(y_m).max()
    # each term as if it added to the others at the corner of both planes
    slopes = SeidelTerms(*np.abs(path)).slope_on_field(*corner, *furthest)
    per_metre = geometry.wave_number / geometry.focal_length_m
    along_x, along_y = (
        float(per_metre * place + slope) / (2 * np.pi) for place, slope in zip(furthest, slopes, strict=True)
    )
    return along_x, along_y


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
    return np.asarray(unitary * sine_matrix(cells) @ _lens_kernel(geometry, _facet(cells, width), plane_m))


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
        facet_y, facet_x = (_facet(count, w) for count in cells)
        factors = couplings(geometry)
        path = geometry.lens_path.mirrored() if second else geometry.lens_path

        def kernel(factor: float, rows: Real, columns: Real) -> Complex:
            return _lens_kernel(geometry, factor * rows, columns)

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


class PipePropagator:
    """Takes a field on the entrance facet's grid to the exit facet's, unitarily.

    The sine modes of the cell carry exp(i (kz - nk) L) with the exact kz. In a sheared pipe the transverse Laplacian in
    (x, y') has the cross term 2 sin t d_x d_y'. It is applied between half steps of the diagonal part (Strang
    splitting), paraxially, as an exact exponential: the derivative couples odd with even sine modes only, and in the
    singular basis of that coupling the exponential is a rotation of pairs. So power is kept to rounding for any step.

    Modes of an axis that fall apart by more than half a turn in a step are left uncoupled (`ParityBasis`). They are far
    apart and weakly coupled, and in the pipe the phase of what they exchange turns; but kicks in the rhythm of those
    turns would drive it. That is most of what few steps do wrong.

    Args:
        geometry: the device.
        cells: sample intervals along (y', x).
        steps: splitting steps over the whole pipe; 1 suffices without shear.

    Attributes:
        bases: sine modes along (y', x), by parity.
        half: phasors of half a step, [2, 2, Ky, Kx] by parity.
        cos, sin: of the turn of each pair of modes in a step, [Ky, Kx].
        steps: splitting steps.
        sheared: whether modes couple at all.
    """

    def __init__(self, geometry: WaveGeometry, cells: tuple[int, int], steps: int) -> None:
        self.sheared = abs(geometry.pipe_angle) > 0
        self.steps = steps if self.sheared else 1
        w, nk = geometry.pipe_width_m, geometry.refractive_index * geometry.wave_number
        dz = geometry.pipe_length_m / self.steps
        self.bases = [_parity_basis(n, float(dz * (np.pi / w) ** 2 / (2 * nk))) for n in cells]
        y, x = (basis.mode_numbers for basis in self.bases)
        detuning = mode_detuning(geometry, y[:, None, :, None], x[None, :, None, :])
        self.half = np.exp(0.5j * dz * detuning).astype(np.complex64)
        coupling = np.outer(self.bases[0].couplings, self.bases[1].couplings) / w**2
        angle = dz / nk * np.sin(geometry.pipe_angle) * coupling
        self.cos = np.cos(angle).astype(np.float32)
        self.sin = np.sin(angle).astype(np.float32)

    def forward(self, field: Complex) -> Complex:
        """Entrance facet [cells_y - 1, cells_x - 1] to exit facet."""
        return self._run(field, adjoint=False)

    def adjoint(self, field: Complex) -> Complex:
        """Exit facet back to entrance facet: the exact inverse, since the pipe is unitary."""
        return self._run(field, adjoint=True)

    def _run(self, field: Complex, *, adjoint: bool) -> Complex:
        y, x = self.bases
        modes = _split(y.sine_by_parity, field, x.sine_by_parity)
        half = self.half.conj() if adjoint else self.half
        full = half * half
        sine = -self.sin if adjoint else self.sin
        modes = modes * half
        for step in range(self.steps):
            if self.sheared:
                modes = _rotate(modes, y.singular, x.singular, self.cos, sine)
            modes = modes * (full if step < self.steps - 1 else half)
        return _join(y.sine_by_parity, modes, x.sine_by_parity)


class ParityBasis:
    """Sine modes of one axis ordered by parity, with the singular basis of the derivative between them.

    Args:
        cells: sample intervals.
        lag: phase in radians by which a mode falls behind in a step, over the square of its number.

    Attributes:
        sine_by_parity: samples of the modes, [2, K, cells - 1], zero where a parity has one mode less.
        mode_numbers: [2, K].
        singular, couplings: singular vectors on either side, [2, K, K], and values [K] of the derivative between modes
            that stay together.
    """

    def __init__(self, cells: int, lag: float) -> None:
        count = cells - 1
        size = (count + 1) // 2
        odd = np.arange(1, count + 1, 2)
        even = np.arange(2, count + 1, 2)
        coupling = np.zeros((size, size))
        m, n = odd[:, None].astype(float), even[None, :].astype(float)
        # (2/w) integral of sin(m pi x/w) d/dx sin(n pi x/w), times w
        coupling[: len(odd), : len(even)] = 4 * m * n / (m**2 - n**2) * _stay_together(lag * (m**2 - n**2))
        left, self.couplings, right = np.linalg.svd(coupling)
        self.singular = np.stack([left, right.T]).astype(np.float32)
        self.mode_numbers = np.zeros((2, size))
        self.mode_numbers[0, : len(odd)] = odd
        self.mode_numbers[1, : len(even)] = even
        sine = sine_matrix(cells)
        self.sine_by_parity = np.zeros((2, size, count), dtype=np.float32)
        self.sine_by_parity[0, : len(odd)] = sine[odd - 1]
        self.sine_by_parity[1, : len(even)] = sine[even - 1]


def _stay_together(apart: Real) -> Real:
    """How far modes are coupled that fall apart by so many radians in a step: beyond about half a turn, not at all."""
    uncoupled, fully = _UNCOUPLED
    return np.clip((uncoupled - np.abs(apart)) / (uncoupled - fully), 0, 1)


@lru_cache(maxsize=8)
def _parity_basis(cells: int, lag: float) -> ParityBasis:
    """It depends on nothing else, and takes as long as the rest of a small propagator."""
    return ParityBasis(cells, lag)


def real_products(left: Real, stack: Complex, right: Real) -> Complex:
    """left @ stack @ right with real factors, as products of the real and the imaginary part."""
    return np.asarray((left @ stack.real @ right) + 1j * (left @ stack.imag @ right), dtype=np.complex64)


def _split(y: Real, field: Complex, x: Real) -> Complex:
    """Field [Ny, Nx] to modes [2, 2, Ky, Kx] by parity."""
    return real_products(y[:, None], field[None, None], x.transpose(0, 2, 1)[None])


def _join(y: Real, modes: Complex, x: Real) -> Complex:
    """Modes [2, 2, Ky, Kx] to field [Ny, Nx]."""
    return np.asarray(real_products(y.transpose(0, 2, 1)[:, None], modes, x[None]).sum(axis=(0, 1)))


def _rotate(modes: Complex, y: Real, x: Real, cos: Real, sin: Real) -> Complex:
    """Apply exp(i angle d_x d_y') to modes [2, 2, Ky, Kx]."""
    inner = real_products(y.transpose(0, 2, 1)[:, None], modes, x[None])
    turned = np.empty_like(inner)
    for (p, q), sign in (((0, 0), 1), ((1, 1), 1), ((0, 1), -1), ((1, 0), -1)):
        turned[p, q] = cos * inner[p, q] + (1j * sign) * (sin * inner[1 - p, 1 - q])
    return real_products(y[:, None], turned, x.transpose(0, 2, 1)[None])


@dataclass(frozen=True)
class WaveChannel:
    """SLM to camera plane: launch lens, light-pipe, de-launch lens.

    Args:
        geometry: the device.
        page_x_m, page_y_m: SLM sample positions against the optical axis, uniform.
        camera_x_m, camera_y_m: camera-plane sample positions against the optical axis, uniform.
        cells: sample intervals of the pipe along (y', x).
        steps: splitting steps of a sheared pipe (`lightpage.waves.grid.splitting_steps`).
        envelope_m: edge of the SLM pixel, whose sinc is applied on the entrance facet; 0 for point samples.
        blur_m: standard deviation of the SLM's blur.

    Every term of the de-launch lens is a product over the camera plane, so its light is computed on few samples
    (`sparse_axis`), and interpolated.
    """

    geometry: WaveGeometry
    page_x_m: Real
    page_y_m: Real
    camera_x_m: Real
    camera_y_m: Real
    cells: tuple[int, int]
    steps: int
    envelope_m: float = 0.0
    blur_m: float = 0.0

    @cached_property
    def launch_lens(self) -> FourierLens:
        """SLM plane to entrance facet."""
        return FourierLens(self.geometry, self.page_x_m, self.page_y_m, self.cells)

    @cached_property
    def delaunch_lens(self) -> FourierLens:
        """Sparse samples of the camera plane to exit facet (its `to_plane` is the de-launch)."""
        return FourierLens(self.geometry, *self.sparse_axes_m, self.cells, second=True)

    @cached_property
    def sparse_axes_m(self) -> tuple[Real, Real]:
        """Axes (x, y) of the samples on which light at the camera plane is computed."""
        axes = self.camera_x_m, self.camera_y_m
        highest = highest_frequencies(self.geometry, self.geometry.lens_path.mirrored(), *axes)
        x, y = (sparse_axis(axis, frequency) for axis, frequency in zip(axes, highest, strict=True))
        return x, y

    @cached_property
    def _between(self) -> tuple[Real, Real] | None:
        """Matrices from those samples to the camera plane's, down and across it; none if they are the same."""
        x, y = self.sparse_axes_m
        if x is self.camera_x_m and y is self.camera_y_m:
            return None
        axes = (self.camera_y_m, y), (self.camera_x_m, x)
        down, across = (interpolation(*both).astype(np.float32) for both in axes)
        return down, across

    @cached_property
    def pipe(self) -> PipePropagator:
        """The light-pipe."""
        return PipePropagator(self.geometry, self.cells, self.steps)

    @cached_property
    def entrance_window(self) -> Real:
        """Transmission of the SLM's pixel shape and blur at the entrance facet, [cells_y - 1, cells_x - 1]."""
        facet_y, facet_x = (_facet(count, self.geometry.pipe_width_m) for count in self.cells)
        window = entrance_window(self.geometry, facet_x, facet_y, self.envelope_m, self.blur_m)
        return np.asarray(window, dtype=np.float32)

    def forward(self, field: Complex) -> Complex:
        """Field on the SLM [ny, nx] to the field on the camera plane."""
        return self.camera_field(self.exit_field(field))

    def exit_field(self, field: Complex) -> Complex:
        """Field on the SLM [ny, nx] to the field on the exit facet's grid."""
        return self.pipe.forward(self.launch_lens.to_facet(field) * self.entrance_window)

    def camera_field(self, exit_field: Complex) -> Complex:
        """Field on the exit facet's grid to the field on the camera plane."""
        sparse = self.delaunch_lens.to_plane(exit_field)
        if self._between is None:
            return sparse
        down, across = self._between
        return real_products(down, sparse, across.T)

    def adjoint(self, field: Complex) -> Complex:
        """Field on the camera plane back to the SLM: undoes the pipe exactly, the chain inside the pipe's band."""
        if self._between is not None:
            down, across = self._between
            field = real_products(down.T, field, across)
        at_entrance = self.pipe.adjoint(self.delaunch_lens.to_facet(field))
        return self.launch_lens.to_plane(at_entrance * self.entrance_window)
