"""Scalar wave optics of the device: lens, light-pipe, lens, on sampled planes, forward and adjoint.

Conventions: time dependence exp(-i omega t), so a wave travels as exp(+i kz z). The pipe's walls are x = +-w/2 and
y' = +-w/2 with y' = x sin t + y cos t, and the field vanishes on them. The common factor exp(i n k L) is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.device.lens_path import IDEAL
from lightpage.waves.arrays import NUMPY, Arrays
from lightpage.waves.geometry import (
    Complex,
    Real,
    WaveGeometry,
    couplings,
    facet_axis,
    highest_frequencies,
    on_facet,
)
from lightpage.waves.lens import FourierLens, entrance_window
from lightpage.waves.pipe import PipePropagator, real_products
from lightpage.waves.sinc_interpolation import interpolation, sparse_axis

_SHAPE = ("envelope_m", "blur_m2")
_CAMERAS = ("camera_x_m", "camera_y_m", "steps")
_PARTS: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "launch_lens": ((*_CAMERAS, *_SHAPE), {"pipe_length_m": 1.0, "camera_path": IDEAL}),
    "entrance_window": (_CAMERAS, {"pipe_length_m": 1.0, "camera_path": IDEAL}),
    "pipe": (
        ("page_x_m", "page_y_m", "camera_x_m", "camera_y_m", *_SHAPE),
        {"focal_length_m": 1.0, "pipe_roll": 0.0, "lens_path": IDEAL, "camera_path": IDEAL},
    ),
    "delaunch_lens": (("page_x_m", "page_y_m", "steps", *_SHAPE), {"pipe_length_m": 1.0, "lens_path": IDEAL}),
}
"""Parts of a channel that take long to make: what they do not depend on, and values that stand for it in a geometry."""


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
        blur_m2: variance of the SLM's blur, square metres; below zero where it transmits fine detail better than its
            pixels' shape says.
        arrays: array library of the fields.

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
    blur_m2: float = 0.0
    arrays: Arrays = NUMPY

    def sharing(self, other: WaveChannel) -> WaveChannel:
        """Return this channel with those parts that another one has made and that are the same in both."""
        for part, (without, usual) in _PARTS.items():
            if part not in vars(other):
                continue
            mine, theirs = (
                {field.name: getattr(each, field.name) for field in fields(each) if field.name not in without}
                | {"geometry": replace(each.geometry, **usual)}
                for each in (self, other)
            )
            if all(np.array_equal(value, theirs[name]) for name, value in mine.items()):
                vars(self)[part] = vars(other)[part]
        return self

    @cached_property
    def launch_lens(self) -> FourierLens:
        """SLM plane to entrance facet."""
        return FourierLens(self.geometry, self.page_x_m, self.page_y_m, self.cells, arrays=self.arrays)

    @cached_property
    def delaunch_lens(self) -> FourierLens:
        """Sparse samples of the camera plane to exit facet (its `to_plane` is the de-launch)."""
        return FourierLens(self.geometry, *self.sparse_axes_m, self.cells, second=True, arrays=self.arrays)

    @cached_property
    def sparse_axes_m(self) -> tuple[Real, Real]:
        """Axes (x, y) of the samples on which light at the camera plane is computed."""
        axes = self.camera_x_m, self.camera_y_m
        highest = highest_frequencies(self.geometry, self.geometry.camera_path, *axes)
        x, y = (sparse_axis(axis, frequency) for axis, frequency in zip(axes, highest, strict=True))
        return x, y

    @cached_property
    def _between(self) -> tuple[Real, Real] | None:
        """Matrices from those samples to the camera plane's, down and across it; none if they are the same."""
        x, y = self.sparse_axes_m
        if x is self.camera_x_m and y is self.camera_y_m:
            return None
        axes = (self.camera_y_m, y), (self.camera_x_m, x)
        down, across = (self.arrays.array(interpolation(*both).astype(np.float32)) for both in axes)
        return down, across

    @cached_property
    def pipe(self) -> PipePropagator:
        """The light-pipe."""
        return PipePropagator(self.geometry, self.cells, self.steps, self.arrays)

    @cached_property
    def entrance_window(self) -> Real:
        """Transmission of the SLM's pixel shape and blur at the entrance facet, [cells_y - 1, cells_x - 1]."""
        facet_y, facet_x = map(facet_axis, self.cells, self.geometry.facet_sides_m())
        window = entrance_window(self.geometry, facet_x, facet_y, self.envelope_m, self.blur_m2)
        entrance: Real = self.arrays.array(np.asarray(window, dtype=np.float32))
        return entrance

    @cached_property
    def facet_radius2_m2(self) -> Real:
        """R^2 of the exit facet's samples, [cells_y - 1, cells_x - 1]."""
        facet_y, facet_x = map(facet_axis, self.cells, self.geometry.facet_sides_m(second=True))
        along, upward = on_facet(couplings(self.geometry), facet_x, facet_y[:, None])
        return np.asarray(along**2 + upward**2)

    def forward(self, field: Complex) -> Complex:
        """Field on the SLM [ny, nx] to the field on the camera plane."""
        return self.camera_field(self.exit_field(field))

    def exit_field(self, field: Complex, passed: NDArray[Any] | float = 1.0) -> Complex:
        """Field on the SLM [ny, nx] to the field on the exit facet's grid.

        Args:
            field: field on the SLM.
            passed: share of the light's amplitude that the entrance facet lets pass, over its grid or everywhere.
        """
        return self.pipe.forward(self.launch_lens.to_facet(field) * (self.entrance_window * passed))

    def camera_field(self, exit_field: Complex, defocus: float = 0.0) -> Complex:
        """Field on the exit facet's grid to the field on the camera plane, or on a plane of further `defocus`.

        Args:
            exit_field: [cells_y - 1, cells_x - 1].
            defocus: factor of R^2 on the facet, rad/m^2.
        """
        if defocus:
            exit_field = exit_field * self._defocused(defocus)
        sparse = self.delaunch_lens.to_plane(exit_field)
        if self._between is None:
            return sparse
        down, across = self._between
        return real_products(down, sparse, across.T)

    def to_exit(self, field: Complex, defocus: float = 0.0) -> Complex:
        """Field on the camera plane, or on one of further `defocus`, back to the exit facet's grid, by the adjoint."""
        if self._between is not None:
            down, across = self._between
            field = real_products(down.T, field, across)
        exit_field = self.delaunch_lens.to_facet(field)
        if defocus:
            exit_field = exit_field * self._defocused(-defocus)
        return exit_field

    def _defocused(self, by: float) -> Complex:
        phasor: Complex = self.arrays.array(np.exp(1j * by * self.facet_radius2_m2).astype(np.complex64))
        return phasor

    def to_page(self, exit_field: Complex) -> Complex:
        """Field on the exit facet's grid back to the SLM, by the adjoint: undoes the pipe exactly."""
        return self.launch_lens.to_plane(self.pipe.adjoint(exit_field) * self.entrance_window)

    def adjoint(self, field: Complex) -> Complex:
        """Field on the camera plane back to the SLM: undoes the pipe exactly, the chain inside the pipe's band."""
        return self.to_page(self.to_exit(field))
