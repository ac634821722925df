"""A lens of the wave model, tile by tile of its plane.

A small tile at (a, b) of the plane sees the facet through phases that vary slowly, once the phase of its own centre is
taken off. So few samples of the facet serve it. A real lens's path and a roll, which factor over no pair of axes, then
leave little, and few terms of it are needed. Strips of tiles with the same a share a first reduction along X.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lightpage.device.lens_path import SeidelTerms
from lightpage.train.models.parts import Matrix, Parts, conjugate, multiply, phasor, scaled, stacked
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
        self.shape = len(plane[1]), len(plane[0])
        self.tiles = tuple(max(1, round(float(np.ptp(axis)) / wave / WAVES_A_TILE)) for axis in plane)
        self.sides = tuple(-(-len(axis) // tiles) for axis, tiles in zip(plane, self.tiles, strict=True))
        pitches = [float(axis[1] - axis[0]) for axis in plane]
        offsets = [(np.arange(side) - (side - 1) / 2) * pitch for side, pitch in zip(self.sides, pitches, strict=True)]
        inside = [
            (np.arange(tiles) * side + (side - 1) / 2) for tiles, side in zip(self.tiles, self.sides, strict=True)
        ]
        centres = [axis[0] + at * pitch for axis, at, pitch in zip(plane, inside, pitches, strict=True)]
        units = [np.arange(1, count) / count - 0.5 for count in reversed(cells)]
        highest = _highest(geometry, path, centres, offsets)
        few = [sparse_axis(unit, frequency, OVERSAMPLING) for unit, frequency in zip(units, highest, strict=True)]
        up_x, up_y = (interpolation(unit, own, OVERSAMPLING) for unit, own in zip(units, few, strict=True))
        self._thinned = tuple(own is not unit for own, unit in zip(few, units, strict=True))
        terms = _terms(geometry, path, centres, offsets, roll_margin, tolerance)
        self.offset_x: Tensor
        self.offset_y: Tensor
        self.inside_x: Tensor
        self.inside_y: Tensor
        self.few_x: Tensor
        self.few_y: Tensor
        self.up_x: Tensor
        self.up_y: Tensor
        self.nodes: Tensor
        self.weights: Tensor
        self.on_x: Tensor
        self.on_y: Tensor
        tiled = (*self.tiles, *terms.nodes.shape[1:])
        for name, value in {
            "offset_x": offsets[0],
            "offset_y": offsets[1],
            "inside_x": inside[0] * pitches[0],
            "inside_y": inside[1] * pitches[1],
            "few_x": few[0],
            "few_y": few[1],
            "up_x": up_x.T,
            "up_y": up_y,
            "nodes": terms.nodes.reshape(tiled),
            "on_x": terms.axes[1].T,
            "on_y": terms.axes[0],
        }.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(value)).float(), persistent=False)
        weights = terms.weights.reshape(*self.tiles, *terms.weights.shape[1:])
        self.register_buffer("weights", stacked(weights), persistent=False)

    @property
    def terms(self) -> int:
        """Number of terms of each tile."""
        return self.nodes.shape[2]

    def matrices(
        self,
        geometry: WaveGeometry,
        path: SeidelTerms,
        start: tuple[Tensor, Tensor],
        facet: tuple[Tensor, Tensor],
        window: Tensor,
    ) -> LensMatrices:
        """The lens for parameters as tensors.

        Args:
            geometry, path: the device, and the lens's path.
            start: the plane's first sample (x, y), metres.
            facet: sample positions along the facet's axes, [fx] and [fy].
            window: transmission of the facet, [fy, fx].
        """
        (across, up), width = facet, geometry.pipe_width_m
        few_x, few_y = self.few_x * width, (self.few_y * width)[:, None]
        a, b = (start[0] + self.inside_x)[:, None, None, None], (start[1] + self.inside_y)[None, :, None, None]
        whole = LensPath(geometry, path, couplings(geometry, torch))
        x, y = self.offset_x, self.offset_y
        strip = whole.phase(a[:, 0], 0.0, across, up[:, None]) + whole.on_facet(across, up[:, None])
        tile = whole.phase(0.0, b, few_x, up[:, None], a)
        to_x = whole.phase(x[:, None], 0.0, few_x, 0.0, a, b)
        to_both = whole.phase(0.0, y[:, None], few_x, 0.0, a, b)
        to_y = whole.phase(0.0, y, 0.0, few_y, a, b)
        node_x, node_y = (self.nodes[..., axis, None, None] for axis in (0, 1))
        rest = whole.rest(node_x, node_y, few_x, few_y, a[..., None], b[..., None])
        area = (x[1] - x[0]) * (y[1] - y[0]) * (few_x[1] - few_x[0]) * (few_y[1, 0] - few_y[0, 0])
        shear: Any = geometry.pipe_angle  # a tensor here, like all of it
        unitary = torch.sqrt(area / torch.cos(shear)) / (geometry.wavelength_m * geometry.focal_length_m)
        plane = self.on_y @ self.weights[0] @ self.on_x, self.on_y @ self.weights[1] @ self.on_x
        return LensMatrices(
            scaled(plane, unitary),
            Matrix.of(phasor(to_x.unsqueeze(2))),
            phasor(to_both.unsqueeze(2)),
            Matrix.of(phasor(to_y.unsqueeze(2))),
            phasor(rest),
            phasor(tile),
            scaled(phasor(strip), window),
        )

    def to_facet(self, lens: LensMatrices, field: Parts) -> Parts:
        """Field on the plane [ny, nx] to the facet's grid [fy, fx]."""
        split = [self._split(part) for part in field]
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
            light = self._across(multiply(field, conjugate(one.strip)), self.up_x.T)
            light = multiply((light[0][None], light[1][None]), conjugate(one.tile))
            light = self._along(self.up_y.T, light)
            terms = multiply((light[0][:, None], light[1][:, None]), conjugate(one.facet))
            terms = multiply(one.y.adjoint.times(terms), conjugate(one.between))
            strips.append(_summed(multiply(one.x.adjoint.behind(terms), conjugate(one.plane)), 1))
        real, imaginary = (self._joined([strip[part] for strip in strips]) for part in (0, 1))
        return real, imaginary

    def _along(self, matrix: Tensor, light: Parts) -> Parts:
        return (matrix @ light[0], matrix @ light[1]) if self._thinned[1] else light

    def _across(self, light: Parts, matrix: Tensor) -> Parts:
        return (light[0] @ matrix, light[1] @ matrix) if self._thinned[0] else light

    def _split(self, part: Tensor) -> Tensor:
        """[ny, nx] to tiles [Tx, Ty, 1, ny, nx], with zeros where they reach beyond."""
        (tiles_x, tiles_y), (side_x, side_y) = self.tiles, self.sides
        part = functional.pad(part, (0, tiles_x * side_x - self.shape[1], 0, tiles_y * side_y - self.shape[0]))
        return part.reshape(tiles_y, side_y, tiles_x, side_x).permute(2, 0, 1, 3)[:, :, None]

    def _joined(self, strips: list[Tensor]) -> Tensor:
        """Strips of tiles [Ty, ny, nx] to [ny, nx]."""
        whole = torch.cat([strip.flatten(0, 1) for strip in strips], dim=-1)
        return whole[: self.shape[0], : self.shape[1]]


def _highest(
    geometry: WaveGeometry, path: SeidelTerms, centres: list[Real], offsets: list[Real]
) -> tuple[float, float]:
    """Frequencies along X and Y' that tiles see of a facet, cycles over its width."""
    half, factors = geometry.pipe_width_m / 2, couplings(geometry)
    per_metre = geometry.wave_number / geometry.focal_length_m
    edge = np.linspace(-half, half, _PLACES)
    across, up = np.meshgrid(edge, edge, indexing="ij")

    def slopes(x: float, y: float) -> tuple[Real, Real]:
        along, upward = path.slope(x, y, *on_facet(factors, across, up))
        along, upward = along - per_metre * x, upward - per_metre * y
        return factors.x_to_x * along + factors.y_to_x * upward, factors.x_to_y * along + factors.y_to_y * upward

    (x_centres, y_centres), most = centres, [0.0, 0.0]
    for a in x_centres:
        of_strip = slopes(a, 0.0)[0]
        for b in y_centres:
            of_tile = slopes(a, b)[1]
            for x in (offsets[0][0], offsets[0][-1]):
                for y in (offsets[1][0], offsets[1][-1]):
                    here = slopes(a + x, b + y)
                    most[0] = max(most[0], float(np.abs(here[0] - of_strip).max()))
                    most[1] = max(most[1], float(np.abs(here[1] - of_tile).max()))
    along_x, along_y = (slope * geometry.pipe_width_m / (2 * np.pi) for slope in most)
    return along_x, along_y


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
