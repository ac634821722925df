"""The wave model of a device as real matrix products, both ways: it trains, and is exported.

It does what `FittedWaves` does. The matrices are made from the parameters in the graph itself, so that a device that
has drifted is decoded by feeding other parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lightpage.calibration.parameters import NAMES, as_dict
from lightpage.calibration.wave_model import (
    FittedWaves,
    fitted_camera_phase,
    fitted_geometry,
    fitted_launch_phase,
    modulator_axes,
)
from lightpage.device.lens_path import SeidelTerms
from lightpage.device.profile import Profile
from lightpage.waves.geometry import WaveGeometry, couplings, detuning, on_facet
from lightpage.waves.grid import FieldGrid, field_grid, symbol_samples
from lightpage.waves.lens import entrance_window
from lightpage.waves.low_rank import Interpolation
from lightpage.waves.pipe import PipePropagator
from lightpage.waves.sinc_interpolation import interpolation
from train.models.parts import Parts, adjoint, conjugate, matmul, multiply, parts, stacked

Real = NDArray[np.float64]

_ROLL_MARGIN = np.deg2rad(0.05)
"""Roll to either side of the fitted one that the terms of the lenses' expansions still serve."""
_TOLERANCE = 3e-4
"""Error of those expansions."""
_TOLERANCE_WITH_PATH = 3e-3
"""The same for lenses that are not ideal: half of the terms that the other takes, and a field error of 0.014."""
_AT_ONCE = 12
"""Terms that go through a product together: as many as an ideal lens has, and a memory's worth of another's."""
ACCURACY = 3 / 8
"""Share of the fitted waves' splitting steps, each of which is time in every decode; a field error of 0.012."""


class LensMatrices(NamedTuple):
    """A lens between its plane and a facet of the pipe; see `FourierLens`.

    Its terms are `facet` on the facet, and on the plane weights [R, degrees, degrees] of polynomials at its samples.
    """

    x: Parts
    between: Parts
    y: Parts
    facet: Parts
    weights: Parts
    on_y: Tensor
    on_x: Tensor


class WaveMatrices(NamedTuple):
    """Everything that depends on the device's parameters; and `down` and `across`, which interpolate to the grid.

    Those two depend on nothing, but would be large as constants.
    """

    launch: LensMatrices
    delaunch: LensMatrices
    down: Tensor
    across: Tensor
    window: Tensor
    at_launch: Parts
    against_reference: Parts
    half_step: Parts
    cos: Tensor
    sin: Tensor


class Waves(nn.Module):
    """Modulator to common grid and back.

    Args:
        profile: the nominal device.
        parameters: [P] of the ray twin, fitted (or, for an oracle, true): they say how finely the pipe is sampled
            and which of its modes couple.
        filled, grid: see `FittedWaves`.

    Attributes:
        samples: on the modulator, per symbol and axis.
    """

    def __init__(
        self, profile: Profile, parameters: Real, *, filled: bool = False, grid: FieldGrid | None = None
    ) -> None:
        super().__init__()
        grid = grid or field_grid(profile)
        self.samples = symbol_samples(profile)
        waves = FittedWaves(profile, parameters, self.samples, filled=filled, accuracy=ACCURACY, grid=grid)
        channel = waves.channel
        x, y = modulator_axes(profile, self.samples)
        self._profile, self._envelope_m = profile, channel.envelope_m
        self.x_m: Tensor
        self.y_m: Tensor
        self.grid_x_m: Tensor
        self.grid_y_m: Tensor
        self.sparse_x_m: Tensor
        self.sparse_y_m: Tensor
        self.facet_x: Tensor
        self.facet_y: Tensor
        self._ideal = profile.ideal_lenses
        self._pipe = _Pipe(channel.pipe)
        for name, value in {
            "x_m": x,
            "y_m": y,
            "grid_x_m": grid.x_m,
            "grid_y_m": grid.y_m,
            "sparse_x_m": channel.sparse_axes_m[0],
            "sparse_y_m": channel.sparse_axes_m[1],
            "facet_x": np.arange(1, channel.cells[1]) / channel.cells[1] - 0.5,
            "facet_y": np.arange(1, channel.cells[0]) / channel.cells[0] - 0.5,
        }.items():
            self.register_buffer(name, torch.from_numpy(value).to(torch.float32), persistent=False)
        centre = np.array([as_dict(parameters)[f"page_centre_{axis}_m"] for axis in "xy"])
        tolerance = _TOLERANCE if self._ideal else _TOLERANCE_WITH_PATH
        self._on_page = _Terms(channel.launch_lens.interpolation(_ROLL_MARGIN, tolerance), centre)
        self._on_camera = _Terms(channel.delaunch_lens.interpolation(_ROLL_MARGIN, tolerance), 0 * centre)
        self.default: Tensor
        self.register_buffer("default", torch.from_numpy(parameters).to(torch.float32), persistent=False)

    def matrices(self, parameters: Tensor | None = None) -> WaveMatrices:
        """What the two ways need, of parameters [P]; of those that the model was made with if left out."""
        value = dict(zip(NAMES, (self.default if parameters is None else parameters).unbind(), strict=True))
        geometry = fitted_geometry(self._profile, value)
        x = self.x_m + value["page_centre_x_m"], self.y_m + value["page_centre_y_m"]
        grid = self.grid_x_m, self.grid_y_m
        facet = self.facet_x * geometry.pipe_width_m, self.facet_y * geometry.pipe_width_m
        window = entrance_window(geometry, *facet, self._envelope_m, xp=torch)
        at_launch = fitted_launch_phase(self._profile, value, geometry, self.x_m[None, :], self.y_m[:, None])
        at_camera = fitted_camera_phase(self._profile, value, geometry, grid[0][None, :], grid[1][:, None])
        path = geometry.lens_path
        if not self._ideal:
            at_launch = at_launch + path.of_field(x[0][None, :], x[1][:, None])
            at_camera = at_camera - path.mirrored().of_field(grid[0][None, :], grid[1][:, None])
        centre = torch.stack([value["page_centre_x_m"], value["page_centre_y_m"]])
        return WaveMatrices(
            self._lens(geometry, *x, facet, path, self._on_page, centre),
            self._lens(geometry, self.sparse_x_m, self.sparse_y_m, facet, path.mirrored(), self._on_camera, 0 * centre),
            interpolation(self.grid_y_m, self.sparse_y_m, xp=torch),
            interpolation(self.grid_x_m, self.sparse_x_m, xp=torch),
            window,
            _phasor(at_launch),
            _phasor(at_camera),
            *self._pipe.matrices(geometry),
        )

    def to_camera(self, at: WaveMatrices, page: Tensor) -> Tensor:
        """Field on the modulator [2, ny samples, nx samples] to the common grid [2, Gy, Gx], against the reference."""
        real, imaginary = _to_facet(at.launch, multiply(parts(page), at.at_launch))
        exit_field = self._pipe.run((real * at.window, imaginary * at.window), at, backwards=False)
        real, imaginary = (at.down @ part @ at.across.T for part in _to_plane(at.delaunch, exit_field))
        return torch.stack(multiply((real, imaginary), at.against_reference))

    def to_page(self, at: WaveMatrices, field: Tensor) -> Tensor:
        """Field on the common grid [2, Gy, Gx] back to the modulator, by the adjoint."""
        seen = multiply(parts(field), conjugate(at.against_reference))
        real, imaginary = (at.down.T @ part @ at.across for part in seen)
        exit_field = _to_facet(at.delaunch, (real, imaginary))
        real, imaginary = self._pipe.run(exit_field, at, backwards=True)
        page = _to_plane(at.launch, (real * at.window, imaginary * at.window))
        return torch.stack(multiply(page, conjugate(at.at_launch)))

    def _lens(
        self,
        geometry: WaveGeometry,
        x: Tensor,
        y: Tensor,
        facet: tuple[Tensor, Tensor],
        path: SeidelTerms,
        terms: _Terms,
        centre: Tensor,
    ) -> LensMatrices:
        """`FourierLens`; what does not factor is interpolated on the plane between nodes, told from its `centre`."""
        factors, (facet_x, facet_y) = couplings(geometry, torch), facet
        per_metre = geometry.wave_number / geometry.focal_length_m
        area = (x[1] - x[0]) * (y[1] - y[0]) * (facet_x[1] - facet_x[0]) * (facet_y[1] - facet_y[0])
        shear: Any = geometry.pipe_angle  # a tensor here, like all of it
        area = area / torch.cos(shear)
        unitary = torch.sqrt(area) / (geometry.wavelength_m * geometry.focal_length_m)

        def kernel(factor: Tensor, rows: Tensor, columns: Tensor) -> Parts:
            return _phasor(-(factor * per_metre * rows)[:, None] * columns[None, :])

        real, imaginary = kernel(factors.x_to_x, x, facet_x)
        nodes, up = terms.nodes + centre, facet_y[:, None]
        node_x, node_y = nodes[:, :1, None], nodes[:, 1:, None]
        rest = -factors.x_to_y * per_metre * node_x * up
        if not self._ideal:
            rest = rest + path.of_both(node_x, node_y, *on_facet(factors, facet_x, up))
        return LensMatrices(
            (real * unitary, imaginary * unitary),
            kernel(factors.y_to_x, y, facet_x),
            kernel(factors.y_to_y, facet_y, y),
            _phasor(rest),
            parts(terms.weights),
            terms.on_y,
            terms.on_x,
        )


def _phasor(phase: Tensor) -> Parts:
    return torch.cos(phase), torch.sin(phase)


def _to_facet(lens: LensMatrices, field: Parts) -> Parts:
    def of(plane: Parts, facet: Parts) -> Parts:
        terms = multiply(matmul(multiply(plane, field), lens.x), lens.between)
        return multiply(matmul(lens.y, terms), facet)

    return _summed(of, lens)


def _to_plane(lens: LensMatrices, field: Parts) -> Parts:
    def of(plane: Parts, facet: Parts) -> Parts:
        terms = multiply(field, conjugate(facet))  # [R, fy, fx]
        terms = multiply(matmul(adjoint(lens.y), terms), conjugate(lens.between))
        return multiply(matmul(terms, adjoint(lens.x)), conjugate(plane))

    return _summed(of, lens)


def _summed(of: Callable[[Parts, Parts], Parts], lens: LensMatrices) -> Parts:
    """The sum over all terms, some at once; on the plane they are made as they are needed, for they are large."""
    total: Parts | None = None
    for first in range(0, len(lens.facet[0]), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        on_x = lens.on_x.transpose(0, 1)
        plane = lens.on_y @ lens.weights[0][some] @ on_x, lens.on_y @ lens.weights[1][some] @ on_x
        real, imaginary = of(plane, (lens.facet[0][some], lens.facet[1][some]))
        more = real.sum(0), imaginary.sum(0)
        total = more if total is None else (total[0] + more[0], total[1] + more[1])
    assert total is not None
    return total


class _Terms(nn.Module):
    """`Interpolation` as tensors, its nodes told from a centre."""

    def __init__(self, terms: Interpolation, centre: Real) -> None:
        super().__init__()
        self.nodes: Tensor
        self.weights: Tensor
        self.on_y: Tensor
        self.on_x: Tensor
        for name, value in {
            "nodes": torch.from_numpy(terms.nodes - centre).float(),
            "weights": stacked(terms.weights),
            "on_y": torch.from_numpy(terms.axes[0]),
            "on_x": torch.from_numpy(terms.axes[1]),
        }.items():
            self.register_buffer(name, value, persistent=False)


def _sine_modes(numbers: Tensor, cells: int) -> Tensor:
    """Samples of the sine modes with these numbers by parity [2, K], [2, K, cells - 1]; a mode 0 is none."""
    places = torch.arange(1, cells, device=numbers.device)
    return math.sqrt(2 / cells) * torch.sin(math.pi / cells * torch.remainder(numbers[..., None] * places, 2 * cells))


class _Pipe(nn.Module):
    """`PipePropagator`."""

    def __init__(self, pipe: PipePropagator) -> None:
        super().__init__()
        y, x = pipe.bases
        self._steps, self._sheared = pipe.steps, pipe.sheared
        self._cells = y.sine_by_parity.shape[-1] + 1, x.sine_by_parity.shape[-1] + 1
        self.y_numbers: Tensor
        self.x_numbers: Tensor
        self.y_couplings: Tensor
        self.x_couplings: Tensor
        self.y_singular: Tensor
        self.x_singular: Tensor
        self.signs: Tensor
        for name, value in (
            ("y_numbers", y.mode_numbers),
            ("x_numbers", x.mode_numbers),
            ("y_couplings", y.couplings),
            ("x_couplings", x.couplings),
            ("y_singular", y.singular[:, None]),
            ("x_singular", x.singular[None]),
            ("signs", np.array([-1.0, 1.0])[:, None, None] * np.array([[1.0, -1.0], [-1.0, 1.0]])),
        ):
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(value)).float(), persistent=False)

    def matrices(self, geometry: WaveGeometry) -> tuple[Parts, Tensor, Tensor]:
        """Phasors of half a step, and cosine and sine of the turn of each pair of modes."""
        width, nk = geometry.pipe_width_m, geometry.refractive_index * geometry.wave_number
        step = geometry.pipe_length_m / self._steps
        squares = self.y_numbers[:, None, :, None] ** 2 + self.x_numbers[None, :, None, :] ** 2
        slow = detuning(nk, squares * (math.pi / width) ** 2, torch.sqrt)
        shear: Any = geometry.pipe_angle
        angle = step / nk * torch.sin(shear) / width**2 * (self.y_couplings[:, None] * self.x_couplings)
        return _phasor(0.5 * step * slow), torch.cos(angle), torch.sin(angle)

    def run(self, field: Parts, at: WaveMatrices, *, backwards: bool) -> Parts:
        """Both parts and all parities go through each product as one stack [2, 2, 2, Ky, Kx]: an exported graph is
        made and run node by node."""
        half, sin = (conjugate(at.half_step), -at.sin) if backwards else (at.half_step, at.sin)
        full, signs = multiply(half, half), self.signs[..., None, None] * sin
        y_cells, x_cells = self._cells
        y_modes, x_modes = _sine_modes(self.y_numbers, y_cells)[:, None], _sine_modes(self.x_numbers, x_cells)[None]
        modes = y_modes @ torch.stack(field)[:, None, None] @ x_modes.transpose(-1, -2)
        modes = self._times(modes, half)
        for step in range(self._steps):
            if self._sheared:
                # what is (p, q) by parity comes from (1 - p, 1 - q), with i and a sign that is one for equal parities
                inner = self.y_singular.transpose(-1, -2) @ modes @ self.x_singular
                turned = at.cos * inner + signs * inner.flip(0, 1, 2)
                modes = self.y_singular @ turned @ self.x_singular.transpose(-1, -2)
            modes = self._times(modes, full if step < self._steps - 1 else half)
        real, imaginary = (y_modes.transpose(-1, -2) @ modes @ x_modes).sum(dim=(1, 2))
        return real, imaginary

    @staticmethod
    def _times(modes: Tensor, phasors: Parts) -> Tensor:
        real, imaginary = phasors
        return modes * real + modes.flip(0) * torch.stack([-imaginary, imaginary])
