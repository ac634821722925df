"""The pipe of the wave model, block by block of its modes.

A shear couples a mode with its neighbours alone: it turns light by less than twice its angle. So a block of modes is
followed with a rim of neighbours around it, which is then dropped. The blocks of low modes need few splitting steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lightpage.train.models.parts import Parts, conjugate, multiply, phasor
from lightpage.waves.geometry import WaveGeometry, detuning
from lightpage.waves.pipe import ParityBasis, modes_by_parity

MODES_A_BLOCK = 120
"""Modes of a parity along each side of a block, at least."""
_RIM = 12
"""Modes of a parity around a block, beyond those that a mirror of twice the shear couples."""
_STEPS = 0.48
"""Steps of a block for an error of one, over the square root of its light's turn: see `TiledPipe`."""
_FEWEST_STEPS = 2


class BlockMatrices(NamedTuple):
    """Phasors of half a step, and cosine and sine of the turn of each pair of modes."""

    half_step: Parts
    cos: Tensor
    sin: Tensor


class SplittingStep(NamedTuple):
    """Splitting step of the pipe, for a geometry of tensors.

    Attributes:
        length_m: length of the step.
        detuning: kz - nk of each mode, [2, 2, Ky, Kx], rad/m.
        angle: turn by the shear of each pair of modes in the singular basis, [Ky, Kx], radians.
    """

    length_m: Tensor
    detuning: Tensor
    angle: Tensor


class PipeModes(nn.Module):
    """Modes of both parities along either axis, and the singular basis of their coupling by a shear.

    Args:
        geometry: the device, about.
        cells: sample intervals along (y', x).
        steps: splitting steps over the pipe's length.
        chosen: modes of each parity along (y', x); all if left out.

    Attributes:
        y_numbers, x_numbers: numbers of the modes, [2, K].
        y_couplings, x_couplings: singular values of the coupling, [K].
        y_singular, x_singular: its singular vectors, [2, 1, Ky, Ky] and [1, 2, Kx, Kx].
    """

    def __init__(
        self,
        geometry: WaveGeometry,
        cells: tuple[int, int],
        steps: int,
        chosen: Sequence[slice] = (slice(None), slice(None)),
    ) -> None:
        super().__init__()
        self.steps, self.sheared = steps, abs(geometry.pipe_angle) > 0
        nk = geometry.refractive_index * geometry.wave_number
        lag = geometry.pipe_length_m / steps * (np.pi / geometry.pipe_width_m) ** 2 / (2 * nk)
        self.y_numbers: Tensor
        self.x_numbers: Tensor
        self.y_couplings: Tensor
        self.x_couplings: Tensor
        self.y_singular: Tensor
        self.x_singular: Tensor
        for axis, cell, modes, other in zip("yx", cells, chosen, (1, 0), strict=True):
            basis = ParityBasis(cell, lag, modes)
            for name, value in (
                ("numbers", basis.mode_numbers),
                ("couplings", basis.couplings),
                ("singular", np.expand_dims(basis.singular, other)),
            ):
                kept = torch.from_numpy(np.ascontiguousarray(value)).float()
                self.register_buffer(f"{axis}_{name}", kept, persistent=False)

    def step(self, geometry: WaveGeometry) -> SplittingStep:
        """Return the splitting step for a geometry of tensors, in their type."""
        width: Any = geometry.pipe_width_m
        shear: Any = geometry.pipe_angle
        y, x = self.y_numbers.to(width.dtype), self.x_numbers.to(width.dtype)
        couplings = self.y_couplings.to(width.dtype)[:, None] * self.x_couplings.to(width.dtype)
        nk = geometry.refractive_index * geometry.wave_number
        length: Any = geometry.pipe_length_m / self.steps
        squares = y[:, None, :, None] ** 2 + x[None, :, None, :] ** 2
        slow = detuning(nk, squares * (math.pi / width) ** 2, torch.sqrt)
        return SplittingStep(length, slow, length / nk * torch.sin(shear) / width**2 * couplings)


class TiledPipe(nn.Module):
    """`lightpage.waves.pipe.PipePropagator` with tensors as geometry, for about the geometry that it is made for.

    With t the shear, kx and ky the transverse wave numbers of a block, L the pipe's length and n k the wave number in
    it, its light is turned by a = t kx ky L / (n k) radians. The error of s steps grows as a s^-1.5 (measured), so that
    the same sum of steps errs least with s as the square root of a.

    One page on a CPU takes less time so than by the whole planes of `BatchedPipe` (docs/guides/speed.md), since blocks
    of low modes need few steps.

    Args:
        geometry: the device.
        cells: sample intervals along (y', x).
        error: wanted error of the splitting.
    """

    def __init__(self, geometry: WaveGeometry, cells: tuple[int, int], error: float) -> None:
        super().__init__()
        self._cells = cells
        sheared = abs(geometry.pipe_angle) > 0
        counts = [cell // 2 for cell in cells]
        edges = [
            np.linspace(0, count, (max(1, count // MODES_A_BLOCK) if sheared else 1) + 1).astype(int)
            for count in counts
        ]
        rims = [math.ceil(abs(geometry.pipe_angle) * other) + _RIM for other in reversed(cells)]
        blocks = []
        for y in pairwise(edges[0]):
            for x in pairwise(edges[1]):
                steps = splitting_steps(geometry, (y, x), error)
                blocks.append(_Block(geometry, cells, (y, x), rims, steps, counts))
        self.blocks = nn.ModuleList(blocks)
        self._across = len(edges[1]) - 1
        self.y_numbers: Tensor
        self.x_numbers: Tensor
        for name, cell in zip(("y_numbers", "x_numbers"), cells, strict=True):
            self.register_buffer(name, torch.from_numpy(modes_by_parity(cell)).float(), persistent=False)

    @property
    def _blocks(self) -> list[_Block]:
        return [block for block in self.blocks if isinstance(block, _Block)]

    def matrices(self, geometry: WaveGeometry) -> list[BlockMatrices]:
        """Return each block's matrices, for a geometry of tensors."""
        return [block.matrices(geometry) for block in self._blocks]

    def forward(self, field: Parts, at: list[BlockMatrices], *, backwards: bool) -> Parts:
        """Propagate a field from facet to facet, [cells_y - 1, cells_x - 1] both.

        Both parts and all parities go through each product as one stack [2, 2, 2, Ky, Kx]: an exported graph is made
        and run node by node. To modes and back, the parities of an axis are one matrix: no product repeats both of its
        factors, which ONNX Runtime gets wrong on a GPU (`lightpage.export.operators.check.repeated_products`).
        """
        y_modes, x_modes = (
            sine_modes(numbers, cells).flatten(0, 1)
            for numbers, cells in zip((self.y_numbers, self.x_numbers), self._cells, strict=True)
        )
        together = y_modes @ torch.stack(field) @ x_modes.transpose(-1, -2)
        modes = together.reshape(2, 2, self.y_numbers.shape[1], 2, self.x_numbers.shape[1]).transpose(2, 3)
        done = [block(modes, own, backwards=backwards) for block, own in zip(self._blocks, at, strict=True)]
        rows = [torch.cat(done[first : first + self._across], dim=-1) for first in range(0, len(done), self._across)]
        together = torch.cat(rows, dim=-2).transpose(2, 3).flatten(3, 4).flatten(1, 2)
        real, imaginary = y_modes.transpose(-1, -2) @ together @ x_modes
        return real, imaginary


class _Block(PipeModes):
    """Block of modes of both parities along either axis, and their neighbours."""

    def __init__(
        self,
        geometry: WaveGeometry,
        cells: tuple[int, int],
        own: tuple[tuple[int, int], tuple[int, int]],
        rims: list[int],
        steps: int,
        counts: list[int],
    ) -> None:
        taken = [
            slice(max(0, a - rim), min(count, b + rim)) for (a, b), rim, count in zip(own, rims, counts, strict=True)
        ]
        super().__init__(geometry, cells, steps, taken)
        self._taken = taken
        self._own = [slice(a - some.start, b - some.start) for (a, b), some in zip(own, taken, strict=True)]
        signs = np.array([-1.0, 1.0])[:, None, None] * np.array([[1.0, -1.0], [-1.0, 1.0]])
        self.signs: Tensor
        self.register_buffer("signs", torch.from_numpy(signs).float(), persistent=False)

    def matrices(self, geometry: WaveGeometry) -> BlockMatrices:
        """Return the block's matrices, for a geometry of tensors."""
        length, slow, angle = self.step(geometry)
        return BlockMatrices(phasor(0.5 * length * slow), torch.cos(angle), torch.sin(angle))

    def forward(self, modes: Tensor, at: BlockMatrices, *, backwards: bool) -> Tensor:
        """All modes [2, 2, 2, Ky, Kx] before the pipe to this block's own behind it."""
        half, sin = (conjugate(at.half_step), -at.sin) if backwards else (at.half_step, at.sin)
        full, signs = multiply(half, half), self.signs[..., None, None] * sin
        modes = _times(modes[..., self._taken[0], self._taken[1]], half)
        for step in range(self.steps):
            if self.sheared:
                # what is (p, q) by parity comes from (1 - p, 1 - q), with i and a sign that is one for equal parities
                inner = self.y_singular.transpose(-1, -2) @ modes @ self.x_singular
                turned = at.cos * inner + signs * _reversed(inner.flatten(0, 2)).reshape(inner.shape)
                modes = self.y_singular @ turned @ self.x_singular.transpose(-1, -2)
            modes = _times(modes, full if step < self.steps - 1 else half)
        return modes[..., self._own[0], self._own[1]]


def _times(modes: Tensor, phasors: Parts) -> Tensor:
    real, imaginary = phasors
    return modes * real + _reversed(modes) * torch.stack([-imaginary, imaginary])


def _reversed(stack: Tensor) -> Tensor:
    """A stack in the opposite order: taken up by index, whole pieces of memory are copied."""
    return stack.index_select(0, torch.arange(len(stack) - 1, -1, -1, device=stack.device))


def splitting_steps(geometry: WaveGeometry, modes: tuple[tuple[int, int], tuple[int, int]], error: float) -> int:
    """Steps in which modes of each parity along (y', x), from one to before another, are followed; see `TiledPipe`."""
    if not abs(geometry.pipe_angle) > 0:
        return 1
    nk = geometry.refractive_index * geometry.wave_number
    y, x = (_mean_wave(some, geometry.pipe_width_m) for some in modes)
    turn = float(abs(geometry.pipe_angle) * y * x * geometry.pipe_length_m / nk)
    wanted: float = _STEPS * math.sqrt(turn) / error ** (2 / 3)
    return max(_FEWEST_STEPS, math.ceil(wanted))


def _mean_wave(modes: tuple[int, int], width: float) -> float:
    """Root mean square wave number of modes of both parities, rad/m."""
    numbers = np.arange(2 * modes[0] + 1, 2 * modes[1] + 1)
    return float(np.sqrt(np.mean((numbers * np.pi / width) ** 2)))


def sine_modes(numbers: Tensor, cells: int) -> Tensor:
    """Samples of the sine modes with these numbers by parity [2, K], [2, K, cells - 1]; a mode 0 is none."""
    places = torch.arange(1, cells, device=numbers.device)
    return math.sqrt(2 / cells) * torch.sin(math.pi / cells * torch.remainder(numbers[..., None] * places, 2 * cells))
