"""A lens of the wave model, tile by tile of its plane.

A small tile at (a, b) of the plane sees the facet through phases that vary slowly, once the phase of its own centre is
taken off. So few samples of the facet serve it. A real lens's path and a roll, which factor over no pair of axes, then
leave little, and few terms of it are needed. Strips of tiles with the same a share a first reduction along X.

`TiledLens` is the form for one page, `lightpage.train.models.batched.lens.BatchedLens` that for many on a GPU. Both
assemble their matrices from the same `TilePhases`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lightpage.device.lens_path import SeidelTerms
from lightpage.train.models import functions
from lightpage.train.models.parts import Matrix, Parts, multiply, multiply_conjugate, phasor, scaled, stacked
from lightpage.waves.geometry import WaveGeometry, couplings, on_facet
from lightpage.waves.lens import LensPath
from lightpage.waves.low_rank import Interpolation, Phase
from lightpage.waves.sinc_interpolation import interpolation, sparse_axis

Real = NDArray[np.floating]

OVERSAMPLING = 1.1
"""Oversampling of light on sparse samples: an error of 0.003."""
WAVES_A_TILE = 170
"""Waves that a tile of the lens is wide, about: more need more samples of the facet, fewer need more tiles."""
ROLL_MARGIN = np.deg2rad(0.05)
"""Roll to either side of the fitted one that the terms of the lenses' expansions still serve."""
_PLACES = 3
"""Places along an axis that are asked how fast the phase varies."""
Slopes = Callable[[float, float], tuple[Any, Any]]
"""Slopes of a phase by X and Y', rad/m, as a tile or a sample at (x, y) sees the facet."""
Window = Callable[[Tensor, Tensor], Tensor]
"""Transmission [fy, fx] of a facet at X [fx] and Y' [fy], metres."""


class PlacedLens(NamedTuple):
    """Lens of a device with given parameters. Numbers are tensors of one type, in which its matrices are computed.

    Attributes:
        geometry: the device.
        path: path of this lens, beyond an ideal one's.
        start: first sample (x, y) of its plane, metres.
        on_plane: phase that light of the plane's samples takes on, [ny, nx], radians.
        window: transmission of the facet; None for one.
    """

    geometry: WaveGeometry
    path: SeidelTerms
    start: tuple[Tensor, Tensor]
    on_plane: Tensor
    window: Window | None


@dataclass(frozen=True)
class TilePhases:
    """Phases of a lens between its tiles and samples of the facet, tiles [Tx, Ty] first, radians.

    The phase of a tile's centre comes on top of the attributes, divided among strips and tiles, or among tilts that
    factor over the axes and the rest.

    Attributes:
        lens: phase of the lens.
        a, b: centres of the tiles, [Tx, 1, 1, 1] and [1, Ty, 1, 1], metres.
        sparse: the samples of the facet, (X [cx], Y' [cy, 1]), metres.
        x: between a tile's columns and the facet's, [Tx, Ty, nx, cx].
        between: between a tile's rows and the facet's columns, [Tx, Ty, ny, cx].
        y: between the facet's rows and a tile's, [Tx, Ty, cy, ny].
        rest: at the nodes of the expansion, [Tx, Ty, R, cy, cx].
        plane: weights of its terms at a tile's samples, times the factor that makes the lens unitary,
            [Tx, Ty, R, ny, nx].
    """

    lens: LensPath
    a: Tensor
    b: Tensor
    sparse: tuple[Tensor, Tensor]
    x: Tensor
    between: Tensor
    y: Tensor
    rest: Tensor
    plane: Parts

    def strips(self, across: Tensor, up: Tensor) -> Tensor:
        """Phases of the strips' centres at X [fx] and Y' [fy, 1] of the facet, [Tx, fy, fx]."""
        return torch.as_tensor(self.lens.phase(self.a[:, 0], 0.0, across, up) + self.lens.on_facet(across, up))

    def tiles(self, across: Tensor, up: Tensor) -> Tensor:
        """Phases of the tiles' centres against their strips', [Tx, Ty, fy, fx]."""
        return torch.as_tensor(self.lens.phase(0.0, self.b, across, up, self.a))

    def tilts(self, across: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
        """Phases of the tiles' centres in an ideal lens that depend on X or Y' alone, [Tx, fx] and [Ty, fy]."""
        factors, per_metre = self.lens.factors, self.lens.per_metre
        along_x = -per_metre * factors.x_to_x * self.a[:, 0, 0] * across
        along_y = -per_metre * factors.y_to_y * self.b[0, :, 0] * up
        return along_x, along_y

    def beyond_tilts(self) -> Tensor:
        """Phases of the tiles' centres less their `tilts` at the few samples, [Tx, Ty, cy, cx]."""
        (across, up), factors = self.sparse, self.lens.factors
        crossed = self.a * factors.x_to_y * up + self.b * factors.y_to_x * across
        path = self.lens.path.of_both(self.a, self.b, *on_facet(factors, across, up))
        return torch.as_tensor(path - self.lens.per_metre * crossed)


class LensMatrices(NamedTuple):
    """A lens for given parameters, tiles [Tx, Ty] first.

    Attributes:
        plane: weights of the terms at a tile's samples, [Tx, Ty, R, ny, nx].
        x: [Tx, Ty, 1, nx, cx] from a tile's columns to its few samples along X.
        between: [Tx, Ty, 1, ny, cx].
        y: [Tx, Ty, 1, cy, ny].
        facet: the terms on a tile's few samples of the facet, [Tx, Ty, R, cy, cx].
        tile: phasors of the tiles' centres against their strips', [Tx, Ty, fy, cx].
        strip: phasors of the strips' centres, with the facet's window, [Tx, fy, fx].
    """

    plane: Parts
    x: Matrix
    between: Parts
    y: Matrix
    facet: Parts
    tile: Parts
    strip: Parts


class TiledLens(nn.Module):
    """`lightpage.waves.lens.FourierLens` with tensors as geometry, for about the geometry that it is made for.

    One page on a CPU takes less time so than by the large products of `BatchedLens` (docs/guides/speed.md).

    Args:
        geometry: the device.
        path: path of this lens, beyond an ideal one's.
        plane: sample positions (x, y) on the lens's plane, uniform, metres.
        cells: sample intervals of the pipe along (y', x).
        roll_margin: radians of roll to either side that are to be served.
        tolerance: error of the expansion.
    """

    def __init__(
        self,
        geometry: WaveGeometry,
        path: SeidelTerms,
        plane: tuple[Real, Real],
        cells: tuple[int, int],
        roll_margin: float,
        tolerance: float,
    ) -> None:
        super().__init__()
        wave = geometry.wavelength_m * geometry.focal_length_m / geometry.pipe_width_m
        self.geometry, self.path, self.cells = geometry, path, cells
        self.shape = len(plane[1]), len(plane[0])
        self.tiles = tuple(max(1, round(float(np.ptp(axis)) / wave / WAVES_A_TILE)) for axis in plane)
        self.sides = tuple(-(-len(axis) // tiles) for axis, tiles in zip(plane, self.tiles, strict=True))
        pitches = [float(axis[1] - axis[0]) for axis in plane]
        self.offsets = [
            (np.arange(side) - (side - 1) / 2) * pitch for side, pitch in zip(self.sides, pitches, strict=True)
        ]
        inside = [
            (np.arange(tiles) * side + (side - 1) / 2) for tiles, side in zip(self.tiles, self.sides, strict=True)
        ]
        self.centres = [axis[0] + at * pitch for axis, at, pitch in zip(plane, inside, pitches, strict=True)]
        slopes = facet_slopes(geometry, path, _PLACES)
        units, sparse = self.facet_samples(slopes, lambda a, b: (slopes(a, 0.0)[0], slopes(a, b)[1]))
        up_x, up_y = (interpolation(unit, own, OVERSAMPLING) for unit, own in zip(units, sparse, strict=True))
        self._thinned = tuple(own is not unit for own, unit in zip(sparse, units, strict=True))
        terms = _terms(geometry, path, self.centres, self.offsets, roll_margin, tolerance)
        self.offset_x: Tensor
        self.offset_y: Tensor
        self.inside_x: Tensor
        self.inside_y: Tensor
        self.unit_x: Tensor
        self.unit_y: Tensor
        self.sparse_x: Tensor
        self.sparse_y: Tensor
        self.up_x: Tensor
        self.up_y: Tensor
        self.nodes: Tensor
        self.weights: Tensor
        self.on_x: Tensor
        self.on_y: Tensor
        by_axis = {
            "offset": self.offsets,
            "inside": [at * pitch for at, pitch in zip(inside, pitches, strict=True)],
            "unit": units,
            "sparse": sparse,
            "up": (up_x.T, up_y),
            "on": (terms.axes[1].T, terms.axes[0]),
        }
        buffers = {f"{name}_{axis}": both[number] for name, both in by_axis.items() for number, axis in enumerate("xy")}
        buffers["nodes"] = terms.nodes.reshape(*self.tiles, *terms.nodes.shape[1:])
        for name, value in buffers.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(value)).float(), persistent=False)
        weights = terms.weights.reshape(*self.tiles, *terms.weights.shape[1:])
        self.register_buffer("weights", stacked(weights), persistent=False)

    @property
    def terms(self) -> int:
        """Number of terms of each tile."""
        return self.nodes.shape[2]

    def facet_samples(self, slopes: Slopes, carrier: Slopes) -> tuple[list[Real], list[Real]]:
        """All samples of the facet along (X, Y'), over its width, and the sparse ones from which its light is known.

        Args:
            slopes: slopes of the phase at (x, y), rad/m.
            carrier: slopes that are subtracted from those of a tile with centre (x, y).
        """
        steepest = [0.0, 0.0]
        for a, b in product(*self.centres):
            carried = carrier(a, b)
            for x, y in product(*((offset[0], offset[-1]) for offset in self.offsets)):
                at_corner = slopes(a + x, b + y)
                for axis in (0, 1):
                    steepest[axis] = max(steepest[axis], float(np.abs(at_corner[axis] - carried[axis]).max()))
        units: list[Real] = [np.arange(1, count) / count - 0.5 for count in reversed(self.cells)]
        cycles = self.geometry.pipe_width_m / (2 * np.pi)  # over the facet's width, of one rad/m
        sparse = [sparse_axis(unit, slope * cycles, OVERSAMPLING) for unit, slope in zip(units, steepest, strict=True)]
        return units, sparse

    def phases(self, placed: PlacedLens, sparse: tuple[Tensor, Tensor]) -> TilePhases:
        """Return the phases of the tiles, for parameters as tensors.

        Args:
            placed: the lens.
            sparse: samples of the facet along (X, Y'), over its width.
        """
        geometry, path, start, *_ = placed
        dtype = start[0].dtype
        sparse_x = sparse[0].to(dtype) * geometry.pipe_width_m
        sparse_y = (sparse[1].to(dtype) * geometry.pipe_width_m)[:, None]
        a = (start[0] + self.inside_x.to(dtype))[:, None, None, None]
        b = (start[1] + self.inside_y.to(dtype))[None, :, None, None]
        lens = LensPath(geometry, path, couplings(geometry, functions))
        x, y = self.offset_x.to(dtype), self.offset_y.to(dtype)
        node_x, node_y = (self.nodes.to(dtype)[..., axis, None, None] for axis in (0, 1))
        area = (x[1] - x[0]) * (y[1] - y[0]) * (sparse_x[1] - sparse_x[0]) * (sparse_y[1, 0] - sparse_y[0, 0])
        shear: Any = geometry.pipe_angle  # a tensor here, like all of it
        unitary = torch.sqrt(area / torch.cos(shear)) / (geometry.wavelength_m * geometry.focal_length_m)
        on_x, on_y = self.on_x.to(dtype), self.on_y.to(dtype)
        plane = on_y @ self.weights[0].to(dtype) @ on_x, on_y @ self.weights[1].to(dtype) @ on_x
        return TilePhases(
            lens,
            a,
            b,
            (sparse_x, sparse_y),
            lens.phase(x[:, None], 0.0, sparse_x, 0.0, a, b),
            lens.phase(0.0, y[:, None], sparse_x, 0.0, a, b),
            lens.phase(0.0, y, 0.0, sparse_y, a, b),
            lens.rest(node_x, node_y, sparse_x, sparse_y, a[..., None], b[..., None]),
            scaled(plane, unitary),
        )

    def matrices(self, placed: PlacedLens) -> LensMatrices:
        """The lens for parameters as tensors."""
        width: Any = placed.geometry.pipe_width_m
        facet_x, facet_y = self.unit_x * width, self.unit_y * width
        phases = self.phases(placed, (self.sparse_x, self.sparse_y))
        strip = phasor(phases.strips(facet_x, facet_y[:, None]))
        return LensMatrices(
            phases.plane,
            Matrix.of(phasor(phases.x.unsqueeze(2))),
            phasor(phases.between.unsqueeze(2)),
            Matrix.of(phasor(phases.y.unsqueeze(2))),
            phasor(phases.rest),
            phasor(phases.tiles(phases.sparse[0], facet_y[:, None])),
            strip if placed.window is None else scaled(strip, placed.window(facet_x, facet_y)),
        )

    def to_facet(self, lens: LensMatrices, field: Parts) -> Parts:
        """Field on the plane [ny, nx] to the facet's grid [fy, fx]."""
        split = [self.split(part) for part in field]
        total: Parts | None = None
        for number in range(self.tiles[0]):
            one = _strip(lens, number)
            terms = multiply(one.plane, (split[0][number], split[1][number]))
            terms = multiply(one.x.behind(terms), one.between)
            light = _summed(multiply(one.y.times(terms), one.facet), 1)
            light = self._along(self.up_y, light)
            light = _summed(multiply(light, one.tile), 0)
            light = multiply(self._across(light, self.up_x), one.strip)
            total = light if total is None else (total[0] + light[0], total[1] + light[1])
        assert total is not None
        return total

    def to_plane(self, lens: LensMatrices, field: Parts) -> Parts:
        """The adjoint: a field on the facet's grid to the plane."""
        strips: list[Parts] = []
        for number in range(self.tiles[0]):
            one = _strip(lens, number)
            light = self._across(multiply_conjugate(field, one.strip), self.up_x.T)
            light = multiply_conjugate((light[0][None], light[1][None]), one.tile)
            light = self._along(self.up_y.T, light)
            terms = multiply_conjugate((light[0][:, None], light[1][:, None]), one.facet)
            terms = multiply_conjugate(one.y.adjoint.times(terms), one.between)
            strips.append(_summed(multiply_conjugate(one.x.adjoint.behind(terms), one.plane), 1))
        real, imaginary = (self._joined([strip[part] for strip in strips]) for part in (0, 1))
        return real, imaginary

    def _along(self, matrix: Tensor, light: Parts) -> Parts:
        return (matrix @ light[0], matrix @ light[1]) if self._thinned[1] else light

    def _across(self, light: Parts, matrix: Tensor) -> Parts:
        return (light[0] @ matrix, light[1] @ matrix) if self._thinned[0] else light

    def split(self, part: Tensor) -> Tensor:
        """[ny, nx] to tiles [Tx, Ty, 1, ny, nx], with zeros where they reach beyond."""
        (tiles_x, tiles_y), (side_x, side_y) = self.tiles, self.sides
        part = functional.pad(part, (0, tiles_x * side_x - self.shape[1], 0, tiles_y * side_y - self.shape[0]))
        return part.reshape(tiles_y, side_y, tiles_x, side_x).permute(2, 0, 1, 3)[:, :, None]

    def _joined(self, strips: list[Tensor]) -> Tensor:
        """Strips of tiles [Ty, ny, nx] to [ny, nx]."""
        whole = torch.cat([strip.flatten(0, 1) for strip in strips], dim=-1)
        return whole[: self.shape[0], : self.shape[1]]


def facet_slopes(geometry: WaveGeometry, path: SeidelTerms, count: int) -> Slopes:
    """Slopes of a lens's phase by X and Y' at so many places along either axis of the facet, rad/m."""
    half, factors = geometry.pipe_width_m / 2, couplings(geometry)
    per_metre = geometry.wave_number / geometry.focal_length_m
    edge = np.linspace(-half, half, count)
    across, up = np.meshgrid(edge, edge, indexing="ij")

    def slopes(x: float, y: float) -> tuple[Real, Real]:
        along, upward = path.slope(x, y, *on_facet(factors, across, up))
        along, upward = along - per_metre * x, upward - per_metre * y
        return factors.x_to_x * along + factors.y_to_x * upward, factors.x_to_y * along + factors.y_to_y * upward

    return slopes


def _terms(
    geometry: WaveGeometry,
    path: SeidelTerms,
    centres: list[Real],
    offsets: list[Real],
    roll_margin: float,
    tolerance: float,
) -> Interpolation:
    """Expand the phases that no factor takes in, over all tiles."""
    half = geometry.pipe_width_m / 2
    rolled = [replace(geometry, pipe_roll=geometry.pipe_roll + share * roll_margin) for share in (-1, 0, 1)]
    phases = [LensPath(one, path, couplings(one)) for one in rolled]

    def of(phase: LensPath, a: float, b: float) -> Phase:
        return lambda x, y, across, up: np.asarray(phase.rest(x, y, across, up, a, b))

    tiles = [[of(phase, a, b) for phase in phases] for a in centres[0] for b in centres[1]]
    edges = np.array([-half, half])
    return Interpolation.of(tiles, (offsets[0], offsets[1]), (edges, edges), tolerance)


def _strip(lens: LensMatrices, number: int) -> LensMatrices:
    """Return the matrices of one strip of tiles."""

    def chosen(value: Any) -> Any:
        return (
            type(value)(*(part[number] for part in value))
            if isinstance(value, Matrix)
            else tuple(part[number] for part in value)
        )

    return LensMatrices(*map(chosen, lens))


def _summed(terms: Parts, axis: int) -> Parts:
    return terms[0].sum(axis), terms[1].sum(axis)
