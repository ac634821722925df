"""The pipe of the wave model for many pages, all of its modes at once."""

from __future__ import annotations

import torch
from torch import Tensor

from lightpage.train.models.batched.products import (
    Tables,
    padded,
    padded_parts,
    real_form,
    sizes,
    turned_product,
    with_phasor,
)
from lightpage.train.models.parts import Parts, phasor
from lightpage.train.models.wave_pipe import MODES_A_BLOCK, PipeModes, splitting_steps
from lightpage.waves.geometry import WaveGeometry

_OF_BLOCKS = 0.75
"""Error of the whole over that which is wanted, where one page's pipe is of several blocks: those of high modes take
more steps than a plane of all. At the full size a page would read 0.005 bit less otherwise."""
Light = list[Tensor]
"""Of modes by parity along (y', x), [B, (Ky, 2), Kx] each, in the singular basis of the shear's coupling.

Those odd along y' are held times -i, by which the coupling becomes a rotation of reals.
"""


class BatchedPipe(PipeModes):
    """`lightpage.train.models.wave_pipe.TiledPipe` in few steps of whole planes.

    A GPU, which computes a page of blocks in thousands of small kernels, is many times as fast so.

    A step is a rotation of pairs and a complex product along either axis: back to modes, their detuning and into the
    singular basis again. The detuning is a sum of a function of either axis's mode but for a rest, which is half a
    radian at most and applied once, in the middle of the pipe.

    Args:
        geometry: the device that it is made for, about.
        cells: sample intervals along (y', x).
        error: of the splitting, wanted.
        backwards: whether light goes from the exit to the entrance.
    """

    def __init__(self, geometry: WaveGeometry, cells: tuple[int, int], error: float, *, backwards: bool) -> None:
        y_modes, x_modes = ((0, count // 2) for count in cells)
        if max(cells) // 2 >= 2 * MODES_A_BLOCK:
            error *= _OF_BLOCKS
        # the rest of the detuning comes between two steps
        super().__init__(geometry, cells, max(2, splitting_steps(geometry, (y_modes, x_modes), error)))
        self.sign = -1 if backwards else 1
        # between which steps it comes: of an odd number, those that make either way the other's adjoint
        self._middle = (self.steps - (2 if backwards else 1)) // 2

    def tables(self, geometry: WaveGeometry) -> tuple[Tables, tuple[Parts, Parts], tuple[Parts, Parts]]:
        """Constants for a geometry of tensors (float64); the ways into the pipe and out of it along (y', x).

        Returns:
            Constants; from modes to the singular basis and half a step on, [2, K, K] along either axis, rows being of
            the singular basis; and from the singular basis half a step on and to modes, columns being of the basis.
        """
        step, slow, turn = self.step(geometry)
        along_y, along_x = slow.mean((1, 3)), slow.mean((0, 2)) - slow.mean()
        rest = slow - along_y[:, None, :, None] - along_x[None, :, None, :]
        tables = {
            "cos": padded(torch.cos(turn), -1, -2)[:, None],
            "sin": padded(self.sign * torch.sin(turn), -1, -2)[:, None],
        }
        middle = padded_parts(phasor(self.sign * geometry.pipe_length_m * rest), -1, -2)
        for p in (0, 1):
            for q in (0, 1):
                # [Ky, t, 1, Kx]
                tables[f"middle_{p}{q}"] = torch.stack([part[p, q] for part in middle], 1)[:, :, None]
        enter, leave = [], []
        for axis, basis, function in (("y", self.y_singular, along_y), ("x", self.x_singular, along_x)):
            half, whole = (phasor(self.sign * share * step * function) for share in (0.5, 1.0))
            vectors = basis.flatten(0, 1).to(function.dtype)
            back = vectors.transpose(-1, -2)
            into = tuple(back * part[:, None, :] for part in half)  # modes, half a step on, to the basis
            out = tuple(part[:, :, None] * vectors for part in half)
            enter.append(padded_parts((into[0], into[1]), -1, -2))
            leave.append(padded_parts((out[0], out[1]), -1, -2))
            through = tuple(back @ (part[:, :, None] * vectors) for part in whole)
            for name, matrix in (
                ("step", padded_parts((through[0], through[1]), -1, -2)),
                ("out", leave[-1]),
                ("in", enter[-1]),
            ):
                # rows of the light times the matrix's transpose
                right = matrix[0].transpose(-1, -2), matrix[1].transpose(-1, -2)
                made = with_phasor(right, "ktr") if (name, axis) == ("in", "y") else real_form(right, "kr")
                for parity in (0, 1):
                    tables[f"{name}_{axis}_{parity}"] = made[parity]
        return tables, (enter[0], enter[1]), (leave[0], leave[1])

    def forward(self, light: Light, tables: Tables) -> Light:
        """Light half a step of detuning behind where it comes in, to half a step before where it leaves."""
        for step in range(self.steps):
            if self.sheared:
                light = self._rotated(light, tables)
            if step == self.steps - 1:
                break
            if step != self._middle:
                light = self._through(light, tables, "step")
            else:
                light = self._through(light, tables, "out")
                rows, columns = sizes(tables["middle_00"])[::3]
                # each is multiplied by both parts of the phasor
                light = [
                    (one.reshape(-1, rows, 1, 2, columns) * tables[f"middle_{number // 2}{number % 2}"]).reshape(
                        -1, 4 * rows, columns
                    )
                    for number, one in enumerate(light)
                ]
                light = self._through(light, tables, "in")
        return light

    @staticmethod
    def _through(light: Light, tables: Tables, name: str) -> Light:
        """A product along y' and one along x of each parity."""
        made = []
        for number, one in enumerate(light):
            along_y, along_x = tables[f"{name}_y_{number // 2}"], tables[f"{name}_x_{number % 2}"]
            columns, (out_y, out_x) = sizes(one)[-1], (sizes(each)[1] for each in (along_y, along_x))
            one = turned_product(one, along_y).reshape(-1, 2 * columns, out_y // 2)
            made.append(turned_product(one, along_x).reshape(-1, out_y, out_x // 2))
        return made

    def _rotated(self, light: Light, tables: Tables) -> Light:
        cos, sin = tables["cos"], tables["sin"]
        rows, columns = sizes(cos)[::2]
        a, b, c, d = (one.reshape(-1, rows, 2, columns) for one in light)
        turned = cos * a - sin * d, cos * b + sin * c, cos * c - sin * b, cos * d + sin * a
        return [one.reshape(-1, 2 * rows, columns) for one in turned]
