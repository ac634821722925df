"""A lens of the wave model for many pages, between a plane's tiles and the pipe's modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lightpage.device.lens_path import SeidelTerms
from lightpage.train.models.batched import functions
from lightpage.train.models.batched.pipe import Light
from lightpage.train.models.batched.products import (
    Tables,
    padded,
    real_form,
    sizes,
    turned_product,
    with_phasor,
)
from lightpage.train.models.parts import Parts, adjoint, conjugate, matmul, multiply, phasor, scaled
from lightpage.train.models.wave_lens import OVERSAMPLING, TiledLens
from lightpage.waves.geometry import WaveGeometry, couplings, on_facet, sine_matrix
from lightpage.waves.lens import LensPath
from lightpage.waves.pipe import modes_by_parity
from lightpage.waves.sinc_interpolation import interpolation, sparse_axis

Real = NDArray[np.floating]
_EDGES = 5
"""Places along an axis of the facet that are asked how fast the phase varies."""


@dataclass(frozen=True)
class Facet:
    """Constants of facet and plane that no lens decides.

    Attributes:
        window: transmission at (X, Y'), [fx] and [fy, 1], metres, as [fy, fx]; None for one.
        on_plane: phase of the plane's samples, [ny, nx], radians.
    """

    window: Any
    on_plane: Tensor


class BatchedLens(nn.Module):
    """`lightpage.train.models.wave_lens.TiledLens` with the pipe's modes in the place of the facet.

    Everything about a tile that is no product of a function of X and one of Y' is taken to few samples of the facet.
    Interpolation to the facet's own grid, the tilt of the tile's centre, the sum over tiles, sine modes and the pipe's
    first half step are then one matrix along either axis.

    Args:
        geometry, path, plane, cells: as of the tiled lens.
        tiled: which has the terms of the lens's rest.
        to_plane: whether light goes from the pipe to the plane, by the adjoint.
    """

    def __init__(
        self,
        geometry: WaveGeometry,
        path: SeidelTerms,
        plane: tuple[Real, Real],
        cells: tuple[int, int],
        tiled: TiledLens,
        *,
        to_plane: bool,
    ) -> None:
        super().__init__()
        self.tiled, self.backwards = tiled, to_plane
        self.shape, self.tiles, self.sides = tiled.shape, tiled.tiles, tiled.sides
        units = [np.arange(1, count) / count - 0.5 for count in reversed(cells)]
        highest = _highest(geometry, path, plane, self.tiles, self.sides)
        few = [sparse_axis(unit, frequency, OVERSAMPLING) for unit, frequency in zip(units, highest, strict=True)]
        for name, unit, own, cell in zip("xy", units, few, reversed(cells), strict=True):
            up = np.eye(len(unit)) if own is unit else interpolation(unit, own, OVERSAMPLING)
            sine = np.concatenate([np.zeros((1, cell - 1)), sine_matrix(cell)])[modes_by_parity(cell).astype(int)]
            for label, value in (("unit", unit), ("few", own), ("up", up), ("sine", sine)):
                self.register_buffer(f"{label}_{name}", torch.from_numpy(value).float(), persistent=False)

    def tables(
        self,
        geometry: WaveGeometry,
        path: SeidelTerms,
        start: tuple[Tensor, Tensor],
        facet: Facet,
        way: tuple[Parts, Parts],
    ) -> Tables:
        """Constants for a geometry of tensors (float64).

        Args:
            geometry, path: the device, and the lens's path.
            start: the plane's first sample (x, y), metres.
            facet: see there.
            way: of `BatchedPipe.tables`, into the pipe or out of it along (y', x).
        """
        tiled, width = self.tiled, geometry.pipe_width_m
        few = {name: self._axis(f"few_{name}") * width for name in "xy"}
        few_x, few_y = few["x"], few["y"][:, None]
        inside = tiled.inside_x.double(), tiled.inside_y.double()
        a, b = (start[0] + inside[0])[:, None, None, None], (start[1] + inside[1])[None, :, None, None]
        factors = couplings(geometry, functions)
        whole, per_metre = LensPath(geometry, path, factors), geometry.wave_number / geometry.focal_length_m
        x, y = tiled.offset_x.double(), tiled.offset_y.double()
        to_x = phasor(whole.phase(x[:, None], 0.0, few_x, 0.0, a, b))
        between = phasor(whole.phase(0.0, y[:, None], few_x, 0.0, a, b))
        to_y = phasor(whole.phase(0.0, y, 0.0, few_y, a, b))
        node_x, node_y = (tiled.nodes.double()[..., axis, None, None] for axis in (0, 1))
        rest = whole.rest(node_x, node_y, few_x, few_y, a[..., None], b[..., None])
        own = path.of_both(a, b, *on_facet(factors, few_x, few_y))
        own = own - per_metre * (a * factors.x_to_y * few_y + b * factors.y_to_x * few_x)
        light = phasor(rest + own[:, :, None])
        if facet.window is not None:
            light = scaled(light, facet.window(few_x, few["y"]))
        area = (x[1] - x[0]) * (y[1] - y[0]) * (few_x[1] - few_x[0]) * (few_y[1, 0] - few_y[0, 0])
        shear: Any = geometry.pipe_angle
        unitary = torch.sqrt(area / torch.cos(shear)) / (geometry.wavelength_m * geometry.focal_length_m)
        on_y, on_x = tiled.on_y.double() * unitary, tiled.on_x.double()
        plane = on_y @ tiled.weights[0].double() @ on_x, on_y @ tiled.weights[1].double() @ on_x
        turned = phasor(facet.on_plane)
        plane = multiply(plane, (self._tiled(turned[0]), self._tiled(turned[1])))
        tilt_x = phasor(-per_metre * factors.x_to_x * a[:, 0, 0] * (self._axis("unit_x") * width))
        tilt_y = phasor(-per_metre * factors.y_to_y * b[0, :, 0] * (self._axis("unit_y") * width))
        to_x, between, to_y, light, plane = map(self._flat, (to_x, between, to_y, light, plane))
        along_y, along_x = self._modes("y", tilt_y), self._modes("x", tilt_x)
        if self.backwards:
            return self._to_plane(to_x, between, to_y, light, plane, along_y, along_x, way)
        return self._to_modes(to_x, between, to_y, light, plane, along_y, along_x, way)

    def _to_modes(
        self, to_x: Parts, between: Parts, to_y: Parts, facet: Parts, plane: Parts, y: Parts, x: Parts, way: Any
    ) -> Tables:
        """Constants of the way from the plane."""
        y, x = _by_parity(way[0], y, odd=True), _by_parity(way[1], x, odd=False)  # [tiles, 2, K, few]
        ty, few_y = sizes(y[0])[0], sizes(y[0])[-1]
        along_y = real_form((_columns(y[0]), _columns(y[1]))).reshape(2, ty, few_y, -1)  # [r, ty, few, (r', p, k)]
        return _between(plane, to_x, _transposed(between), _transposed(to_y), _transposed(facet)) | {
            "modes_y": along_y.permute(1, 0, 2, 3).reshape(ty * 2 * few_y, -1),
            "modes_x": real_form((_columns(x[0]), _columns(x[1])), "kr"),
        }

    def _to_plane(
        self, to_x: Parts, between: Parts, to_y: Parts, facet: Parts, plane: Parts, y: Parts, x: Parts, way: Any
    ) -> Tables:
        """Constants of the way to the plane, by the adjoint."""
        tables: Tables = {}
        for name, modes, out in (("y", y, way[0]), ("x", x, way[1])):
            for parity in (0, 1):
                back = adjoint((modes[0][:, parity], modes[1][:, parity]))  # [tiles, few, K]
                made = matmul(back, (out[0][parity], out[1][parity]))
                if name == "y" and parity:
                    made = _times_i(made)  # light odd along y' is held times -i
                columns = made[0].permute(2, 0, 1).flatten(1), made[1].permute(2, 0, 1).flatten(1)
                tables[f"modes_{name}_{parity}"] = real_form(columns, "kr")
        near, far = conjugate(_transposed(facet)), conjugate(plane)
        return tables | _between(near, conjugate(to_y), conjugate(between), conjugate(_transposed(to_x)), far)

    def to_modes(self, field: Tensor, tables: Tables) -> Light:
        """Field on the plane, `laid_out`, [B, 2, Ty ny, Tx nx], to light in the pipe."""
        tx, ty = self.tiles
        _, _, rows, _, _, columns = sizes(tables["near_0"])
        field = field.reshape(-1, 2, ty, rows, tx, columns).permute(4, 2, 0, 3, 1, 5)
        light = _from_near(field.reshape(tx * ty, -1, rows, 1, 2, columns), tables)  # [T, B, few x, r, few y]
        few_x, few_y = sizes(tables["far_0_0"])[2::2]
        light = light.reshape(tx, ty, -1, few_x, 2, few_y).permute(2, 0, 3, 1, 4, 5)
        light = light.reshape(-1, tx * few_x, ty * 2 * few_y) @ tables["modes_y"]  # [B, (tx, few x), (r, p, ky)]
        modes_y, modes_x = (sizes(tables[f"modes_{axis}"])[1] // 4 for axis in "yx")
        light = turned_product(light.reshape(-1, tx * few_x * 2, 2 * modes_y), tables["modes_x"])
        split = light.reshape(-1, 2, 2 * modes_y, 2, modes_x)  # [B, p, (ky, r), q, kx]
        return [split[:, p, :, q] for p in (0, 1) for q in (0, 1)]

    def to_plane(self, light: Light, tables: Tables) -> Tensor:
        """Light in the pipe to a field on the plane, `laid_out`, [B, 2, Ty ny, Tx nx]."""
        tx, ty = self.tiles
        _, _, few_x, _, _, few_y = sizes(tables["near_0"])
        total: Tensor | None = None
        for q in (0, 1):
            modes = sizes(light[q])[-1]
            even, odd = (turned_product(light[2 * p + q], tables[f"modes_y_{p}"]) for p in (0, 1))
            along_y = (even + odd).reshape(-1, 2 * modes, ty * few_y)  # [B, (kx, r), (ty, few y)]
            one = turned_product(along_y, tables[f"modes_x_{q}"])
            total = one if total is None else total + one
        assert total is not None
        facet = total.reshape(-1, ty, few_y, 2, tx, few_x).permute(4, 1, 0, 5, 3, 2)
        tiled = _from_near(facet.reshape(tx * ty, -1, few_x, 1, 2, few_y), tables)  # [T, B, ny, r, nx]
        rows, columns = sizes(tables["far_0_0"])[2::2]
        field = tiled.reshape(tx, ty, -1, rows, 2, columns).permute(2, 4, 1, 3, 0, 5)
        return field.reshape(-1, 2, ty * rows, tx * columns)

    def laid_out(self, matrix: Tensor, axis: str) -> Tensor:
        """Columns of a matrix [m, n], one a sample of the plane along an axis, tile by tile, [m, T n] with zeros."""
        number = "xy".index(axis)
        tiles, side = self.tiles[number], self.sides[number]
        whole = functional.pad(matrix, (0, tiles * side - matrix.shape[1]))
        return padded(whole.reshape(-1, tiles, side), -1).flatten(1)

    def cropped(self, field: Tensor) -> Tensor:
        """Return what is `laid_out`, [B, 2, Ty ny, Tx nx], as the plane has it, [B, 2, ny, nx]."""
        (tx, ty), (side_x, side_y) = self.tiles, self.sides
        rows, columns = (count // tiles for count, tiles in zip(sizes(field)[-2:], (ty, tx), strict=True))
        tiled = field.reshape(-1, 2, ty, rows, tx, columns)[:, :, :, :side_y, :, :side_x]
        return tiled.reshape(-1, 2, ty * side_y, tx * side_x)[:, :, : self.shape[0], : self.shape[1]]

    def _axis(self, name: str) -> Tensor:
        """A buffer as float64."""
        return torch.as_tensor(self.get_buffer(name)).double()

    def _tiled(self, part: Tensor) -> Tensor:
        """[ny, nx] to tiles [Tx, Ty, 1, ny, nx], with zeros where they reach beyond."""
        (tx, ty), (side_x, side_y) = self.tiles, self.sides
        part = functional.pad(part, (0, tx * side_x - self.shape[1], 0, ty * side_y - self.shape[0]))
        return part.reshape(ty, side_y, tx, side_x).permute(2, 0, 1, 3)[:, :, None]

    def _modes(self, axis: str, tilt: Parts) -> Parts:
        """Return sine modes by parity [tiles, 2, K, few] of a facet's few samples, by each tile's tilt [tiles, f]."""
        sine, up = self._axis(f"sine_{axis}"), self._axis(f"up_{axis}")
        real, imaginary = (padded(sine @ (part[:, None, :, None] * up), -1, -2) for part in tilt)
        return real, imaginary

    @staticmethod
    def _flat(value: Parts) -> Parts:
        """[Tx, Ty, ...] to [T, ...], a row of numbers in a multiple along the last two axes."""
        real, imaginary = (padded(part.flatten(0, 1), -1, -2) for part in value)
        return real, imaginary


def _between(near: Parts, along: Parts, between: Parts, across: Parts, far: Parts) -> Tables:
    """Constants of `_from_near`.

    Args:
        near: the terms where light comes from, [T, R, n, m].
        along: [T, m, k].
        between: [T, k, n].
        across: [T, n, j].
        far: the terms where it goes to, [T, R, k, j].
    """
    tables = {
        "along": with_phasor(along),
        "between": _pair(between, -2)[:, None, :, :, None],
        "across_0": with_phasor(across),
        "across_1": with_phasor(_times_i(across)),
    }
    for term in range(sizes(near[0])[1]):
        tables[f"near_{term}"] = _pair((near[0][:, term], near[1][:, term]), -2)[:, None, :, :, None]
        for part in (0, 1):
            tables[f"far_{term}_{part}"] = far[part][:, term, None, :, None]
    return tables


def _from_near(light: Tensor, tables: Tables) -> Tensor:
    """Light of each tile, [T, B, n, 1, r, m], through the terms to the other plane, [T, B, k, r, j].

    Term by term: a GPU's kernels that sum along an axis of planes are slow, and so are those that take one out of many.
    A product's two outcomes are one that is multiplied by a phasor's real part, and one by its imaginary part.
    """
    count, _, rows, _, _, columns = sizes(tables["near_0"])
    inner = sizes(tables["between"])[2]
    total: Tensor | None = None
    for term in range(sum(name.startswith("near_") for name in tables)):
        one = (light * tables[f"near_{term}"]).reshape(count, -1, 4 * columns) @ tables["along"]
        one = one.reshape(count, -1, rows, 2, inner).permute(0, 1, 4, 3, 2)  # [T, B, k, r, n]
        one = (one.unsqueeze(3) * tables["between"]).reshape(count, -1, 4 * rows)
        for part in (0, 1):
            ended = one @ tables[f"across_{part}"]
            ended = ended.reshape(count, -1, inner, 2, sizes(ended)[-1] // 2) * tables[f"far_{term}_{part}"]
            total = ended if total is None else total + ended
    assert total is not None
    return total


def _pair(value: Parts, axis: int) -> Tensor:
    return torch.stack(list(value), axis)


def _transposed(value: Parts) -> Parts:
    return value[0].transpose(-1, -2), value[1].transpose(-1, -2)


def _times_i(value: Parts) -> Parts:
    return -value[1], value[0]


def _columns(modes: Tensor) -> Tensor:
    """[tiles, parities, K, few] to [(tiles, few), (parities, K)]."""
    return modes.permute(0, 3, 1, 2).flatten(2).flatten(0, 1)


def _by_parity(way: Parts, modes: Parts, *, odd: bool) -> Parts:
    """A matrix of either parity [2, K, K] times sine modes [tiles, 2, K, few]; odd ones times -i if asked."""
    real, imaginary = matmul(way, modes)
    if not odd:
        return real, imaginary
    return torch.stack([real[:, 0], imaginary[:, 1]], 1), torch.stack([imaginary[:, 0], -real[:, 1]], 1)


def _highest(
    geometry: WaveGeometry, path: SeidelTerms, plane: tuple[Real, Real], tiles: tuple[int, ...], sides: tuple[int, ...]
) -> tuple[float, float]:
    """Frequencies along X and Y' that tiles see of a facet, their centre's tilt taken off, cycles over its width."""
    half, factors = geometry.pipe_width_m / 2, couplings(geometry)
    per_metre = geometry.wave_number / geometry.focal_length_m
    edge = np.linspace(-half, half, _EDGES)
    across, up = np.meshgrid(edge, edge, indexing="ij")
    pitches = [float(axis[1] - axis[0]) for axis in plane]
    centres = [
        axis[0] + (np.arange(count) * side + (side - 1) / 2) * pitch
        for axis, count, side, pitch in zip(plane, tiles, sides, pitches, strict=True)
    ]
    reach = [(side - 1) / 2 * pitch for side, pitch in zip(sides, pitches, strict=True)]
    most = [0.0, 0.0]
    for a in centres[0]:
        for b in centres[1]:
            for x in (-reach[0], reach[0]):
                for y in (-reach[1], reach[1]):
                    along, upward = path.slope(a + x, b + y, *on_facet(factors, across, up))
                    along, upward = along - per_metre * (a + x), upward - per_metre * (b + y)
                    on_x = factors.x_to_x * along + factors.y_to_x * upward + per_metre * a * factors.x_to_x
                    on_y = factors.x_to_y * along + factors.y_to_y * upward + per_metre * b * factors.y_to_y
                    most = [max(most[0], float(np.abs(on_x).max())), max(most[1], float(np.abs(on_y).max()))]
    across_x, across_y = (slope * geometry.pipe_width_m / (2 * np.pi) for slope in most)
    return across_x, across_y
