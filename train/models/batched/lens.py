"""A lens of the wave model for many pages, between a plane's tiles and the pipe's modes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

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
from lightpage.train.models.wave_lens import OVERSAMPLING, PlacedLens, TiledLens, facet_slopes
from lightpage.train.models.wave_pipe import sine_modes
from lightpage.waves.geometry import couplings
from lightpage.waves.pipe import modes_by_parity
from lightpage.waves.sinc_interpolation import interpolation

_EDGES = 5
"""Places along an axis of the facet that are asked how fast the phase varies."""


class BatchedLens(nn.Module):
    """`lightpage.train.models.wave_lens.TiledLens` with the pipe's modes in the place of the facet.

    Everything about a tile that is no product of a function of X and one of Y' is taken to few samples of the facet.
    Interpolation to the facet's own grid, the tilt of the tile's centre, the sum over tiles, sine modes and the pipe's
    first half step are then one matrix along either axis.

    A GPU is many times as fast by its few large products as by the strips of `TiledLens`.

    Args:
        tiled: the lens, with its tiles and the terms of its rest.
        to_plane: whether light goes from the pipe to the plane, by the adjoint.
    """

    def __init__(self, tiled: TiledLens, *, to_plane: bool) -> None:
        super().__init__()
        self.tiled, self.backwards = tiled, to_plane
        self.shape, self.tiles, self.sides = tiled.shape, tiled.tiles, tiled.sides
        geometry, factors = tiled.geometry, couplings(tiled.geometry)
        per_metre = geometry.wave_number / geometry.focal_length_m
        slopes = facet_slopes(geometry, tiled.path, _EDGES)
        units, sparse = tiled.facet_samples(
            slopes, lambda a, b: (-per_metre * factors.x_to_x * a, -per_metre * factors.y_to_y * b)
        )
        for name, unit, own, cell in zip("xy", units, sparse, reversed(tiled.cells), strict=True):
            up = np.eye(len(unit)) if own is unit else interpolation(unit, own, OVERSAMPLING)
            for label, value in (("sparse", own), ("up", up), ("numbers", modes_by_parity(cell))):
                self.register_buffer(f"{label}_{name}", torch.from_numpy(value).float(), persistent=False)

    def tables(self, placed: PlacedLens, way: tuple[Parts, Parts]) -> Tables:
        """Constants of a lens with tensors of float64.

        Args:
            placed: the lens.
            way: of `BatchedPipe.tables`, into the pipe or out of it along (y', x).
        """
        tiled, width = self.tiled, placed.geometry.pipe_width_m
        phases = tiled.phases(placed, (self._axis("sparse_x"), self._axis("sparse_y")))
        light = phasor(phases.rest + phases.beyond_tilts()[:, :, None])
        if placed.window is not None:
            light = scaled(light, placed.window(phases.sparse[0], phases.sparse[1][:, 0]))
        turned = phasor(placed.on_plane)
        plane = multiply(phases.plane, (tiled.split(turned[0]), tiled.split(turned[1])))
        tilt_x, tilt_y = map(phasor, phases.tilts(tiled.unit_x.double() * width, tiled.unit_y.double() * width))
        to_x, between, to_y = (phasor(phase) for phase in (phases.x, phases.between, phases.y))
        to_x, between, to_y, light, plane = map(self._flat, (to_x, between, to_y, light, plane))
        along_y, along_x = self._modes("y", tilt_y), self._modes("x", tilt_x)
        if self.backwards:
            return self._to_plane(to_x, between, to_y, light, plane, along_y, along_x, way)
        return self._to_modes(to_x, between, to_y, light, plane, along_y, along_x, way)

    def _to_modes(
        self, to_x: Parts, between: Parts, to_y: Parts, facet: Parts, plane: Parts, y: Parts, x: Parts, way: Any
    ) -> Tables:
        """Constants of the way from the plane."""
        y, x = _by_parity(way[0], y, odd=True), _by_parity(way[1], x, odd=False)  # [tiles, 2, K, sparse]
        ty, sparse_y = sizes(y[0])[0], sizes(y[0])[-1]
        along_y = real_form((_columns(y[0]), _columns(y[1]))).reshape(
            2, ty, sparse_y, -1
        )  # [r, ty, sparse, (r', p, k)]
        return _between(plane, to_x, _transposed(between), _transposed(to_y), _transposed(facet)) | {
            "modes_y": along_y.permute(1, 0, 2, 3).reshape(ty * 2 * sparse_y, -1),
            "modes_x": real_form((_columns(x[0]), _columns(x[1])), "kr"),
        }

    def _to_plane(
        self, to_x: Parts, between: Parts, to_y: Parts, facet: Parts, plane: Parts, y: Parts, x: Parts, way: Any
    ) -> Tables:
        """Constants of the way to the plane, by the adjoint."""
        tables: Tables = {}
        for name, modes, out in (("y", y, way[0]), ("x", x, way[1])):
            for parity in (0, 1):
                back = adjoint((modes[0][:, parity], modes[1][:, parity]))  # [tiles, sparse, K]
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
        light = _from_near(field.reshape(tx * ty, -1, rows, 1, 2, columns), tables)  # [T, B, sparse x, r, sparse y]
        sparse_x, sparse_y = sizes(tables["far_0_0"])[2::2]
        light = light.reshape(tx, ty, -1, sparse_x, 2, sparse_y).permute(2, 0, 3, 1, 4, 5)
        light = (
            light.reshape(-1, tx * sparse_x, ty * 2 * sparse_y) @ tables["modes_y"]
        )  # [B, (tx, sparse x), (r, p, ky)]
        modes_y, modes_x = (sizes(tables[f"modes_{axis}"])[1] // 4 for axis in "yx")
        light = turned_product(light.reshape(-1, tx * sparse_x * 2, 2 * modes_y), tables["modes_x"])
        split = light.reshape(-1, 2, 2 * modes_y, 2, modes_x)  # [B, p, (ky, r), q, kx]
        return [split[:, p, :, q] for p in (0, 1) for q in (0, 1)]

    def to_plane(self, light: Light, tables: Tables) -> Tensor:
        """Light in the pipe to a field on the plane, `laid_out`, [B, 2, Ty ny, Tx nx]."""
        tx, ty = self.tiles
        _, _, sparse_x, _, _, sparse_y = sizes(tables["near_0"])
        total: Tensor | None = None
        for q in (0, 1):
            modes = sizes(light[q])[-1]
            even, odd = (turned_product(light[2 * p + q], tables[f"modes_y_{p}"]) for p in (0, 1))
            along_y = (even + odd).reshape(-1, 2 * modes, ty * sparse_y)  # [B, (kx, r), (ty, sparse y)]
            one = turned_product(along_y, tables[f"modes_x_{q}"])
            total = one if total is None else total + one
        assert total is not None
        facet = total.reshape(-1, ty, sparse_y, 2, tx, sparse_x).permute(4, 1, 0, 5, 3, 2)
        tiled = _from_near(facet.reshape(tx * ty, -1, sparse_x, 1, 2, sparse_y), tables)  # [T, B, ny, r, nx]
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

    def _modes(self, axis: str, tilt: Parts) -> Parts:
        """Return sine modes by parity [tiles, 2, K, sparse] of sparse samples, by each tile's tilt [tiles, f]."""
        cells = self.tiled.cells["yx".index(axis)]
        sine, up = sine_modes(self._axis(f"numbers_{axis}"), cells), self._axis(f"up_{axis}")
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
    """[tiles, parities, K, sparse] to [(tiles, sparse), (parities, K)]."""
    return modes.permute(0, 3, 1, 2).flatten(2).flatten(0, 1)


def _by_parity(way: Parts, modes: Parts, *, odd: bool) -> Parts:
    """A matrix of either parity [2, K, K] times sine modes [tiles, 2, K, sparse]; odd ones times -i if asked."""
    real, imaginary = matmul(way, modes)
    if not odd:
        return real, imaginary
    return torch.stack([real[:, 0], imaginary[:, 1]], 1), torch.stack([imaginary[:, 0], -real[:, 1]], 1)
