"""The pipe: modes between its walls, from facet to facet."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from lightpage.waves.arrays import NUMPY, Arrays
from lightpage.waves.geometry import UNCOUPLED, Complex, Real, WaveGeometry, mode_detuning, sine_matrix


class PipePropagator:
    """Takes a field on the entrance facet's grid to the exit facet's, unitarily.

    The sine modes of the cell carry exp(i (kz - nk) L) with the exact kz. In a sheared pipe the transverse Laplacian in
    (x, y') has the cross term 2 sin t d_x d_y'. It is applied between half steps of the diagonal part (Strang
    splitting), paraxially, as an exact exponential: the derivative couples odd with even sine modes only, and in the
    singular basis of that coupling the exponential is a rotation of pairs. So power is kept to rounding for any step.

    Modes of an axis that fall apart by more than half a turn in a step are left uncoupled (`ParityBasis`). They are far
    apart and weakly coupled, and in the pipe the phase of what they exchange turns; but kicks in the rhythm of those
    turns would drive it. That is most of what few steps do wrong.

    The modes of a pipe that tapers widen with it and are bent: paraxially, they are those of an even pipe of the mean
    width between facets of other widths. The phase on each facet (`taper_defocus`) is not applied here.

    Args:
        geometry: the device.
        cells: sample intervals along (y', x).
        steps: splitting steps over the whole pipe; 1 suffices without shear.
        arrays: array library of the fields.

    Attributes:
        steps: splitting steps.
        sheared: whether modes couple at all.
    """

    def __init__(self, geometry: WaveGeometry, cells: tuple[int, int], steps: int, arrays: Arrays = NUMPY) -> None:
        self.sheared = abs(geometry.pipe_angle) > 0
        self.steps = steps if self.sheared else 1
        w, nk = geometry.pipe_width_m, geometry.refractive_index * geometry.wave_number
        dz = geometry.pipe_length_m / self.steps
        sides = w * (1 + geometry.pipe_height_relative), w
        bases = [
            _parity_basis(n, float(dz * (np.pi / side) ** 2 / (2 * nk))) for n, side in zip(cells, sides, strict=True)
        ]
        y, x = (basis.mode_numbers for basis in bases)
        detuning = mode_detuning(geometry, y[:, :, None], x[_OTHER][:, :, None, :])
        coupling = np.outer(bases[0].couplings, bases[1].couplings) / w**2
        coupling /= 1 + geometry.pipe_height_relative
        angle = dz / nk * np.sin(geometry.pipe_angle) * coupling
        self._arrays = arrays
        self._sine_y, self._pairs_y = (arrays.array(part) for part in (bases[0].sine_by_parity, bases[0].singular))
        self._sine_x, self._pairs_x = (
            arrays.array(part[_OTHER]) for part in (bases[1].sine_by_parity, bases[1].singular)
        )
        self._half = arrays.array(np.exp(0.5j * dz * detuning).astype(np.complex64))
        self._cos = arrays.array(np.cos(angle).astype(np.complex64))
        self._turn = arrays.array((1j * _ONE_WAY[:, None, None, None] * np.sin(angle)).astype(np.complex64))

    def forward(self, field: Complex) -> Complex:
        """Entrance facet [cells_y - 1, cells_x - 1] to exit facet."""
        return self._run(field, adjoint=False)

    def adjoint(self, field: Complex) -> Complex:
        """Exit facet back to entrance facet: the exact inverse, since the pipe is unitary."""
        return self._run(field, adjoint=True)

    def _run(self, field: Complex, *, adjoint: bool) -> Complex:
        half, turn = (self._half.conj(), -self._turn) if adjoint else (self._half, self._turn)

        def through(kinds: slice) -> Complex:
            sine_x, pairs_x = self._sine_x[kinds], self._pairs_x[kinds]
            mine, turning = half[kinds], turn[kinds]
            full = mine * mine
            modes = real_products(self._sine_y, field, sine_x.swapaxes(2, 3)) * mine
            for step in range(self.steps):
                if self.sheared:
                    modes = self._rotate(modes, pairs_x, turning)
                modes = modes * (full if step < self.steps - 1 else mine)
            fields: Any = real_products(self._sine_y.swapaxes(1, 2), modes, sine_x)
            there: Complex = fields.sum((0, 1))
            return there

        leaving: Complex = self._arrays.sum(through, len(_OTHER))
        return leaving

    def _rotate(self, modes: Complex, pairs_x: Real, turn: Complex) -> Complex:
        """Apply exp(i angle d_x d_y') to modes [kinds, 2, Ky, Kx]."""
        y, flip = self._pairs_y, self._arrays.xp.flip
        inner = real_products(y.swapaxes(1, 2), modes, pairs_x)
        turned = self._cos * inner + turn * flip(inner, (1,))
        return real_products(y, turned, pairs_x.swapaxes(2, 3))


_OTHER = np.array([[0, 1], [1, 0]])
"""Parity along x of modes whose parity along y' is the column. The rows are two kinds that never meet: a shear takes
modes of parities (p, q) to (1 - p, 1 - q)."""
_ONE_WAY = np.array([1, -1])
"""Sense of the turn of either kind."""


class ParityBasis:
    """Sine modes of one axis ordered by parity, with the singular basis of the derivative between them.

    Args:
        cells: sample intervals.
        lag: phase in radians by which a mode falls behind in a step, over the square of its number.
        chosen: modes of each parity to take, all if left out.

    Attributes:
        sine_by_parity: samples of the modes, [2, K, cells - 1], zero where a parity has one mode less.
        mode_numbers: [2, K].
        singular, couplings: singular vectors on either side, [2, K, K], and values [K] of the derivative between modes
            that stay together.
    """

    def __init__(self, cells: int, lag: float, chosen: slice = slice(None)) -> None:
        self.mode_numbers = modes_by_parity(cells)[:, chosen]
        m, n = self.mode_numbers[0, :, None], self.mode_numbers[1, None, :]
        # (2/w) integral of sin(m pi x/w) d/dx sin(n pi x/w), times w
        coupling = 4 * m * n / (m**2 - n**2) * _stay_together(lag * (m**2 - n**2))
        left, self.couplings, right = np.linalg.svd(coupling)
        self.singular = np.stack([left, right.T]).astype(np.float32)
        sine = np.concatenate([np.zeros((1, cells - 1)), sine_matrix(cells)])
        self.sine_by_parity = sine[self.mode_numbers.astype(int)].astype(np.float32)


def modes_by_parity(cells: int) -> Real:
    """Numbers of all modes of an axis with so many sample intervals, odd and even, [2, K]; 0 where there is none."""
    numbers = np.arange(1, 2 * (cells // 2) + 1).reshape(-1, 2).T
    return np.where(numbers < cells, numbers, 0).astype(float)


def _stay_together(apart: Real) -> Real:
    """Return how far modes stay coupled whose phases part by so many radians in a step: 1 near 0, 0 beyond about pi."""
    uncoupled, fully = UNCOUPLED
    return np.clip((uncoupled - np.abs(apart)) / (uncoupled - fully), 0, 1)


@lru_cache(maxsize=8)
def _parity_basis(cells: int, lag: float) -> ParityBasis:
    """Return the parity basis, cached, since it takes as long as the rest of a small propagator."""
    return ParityBasis(cells, lag)


def real_products(left: Real, stack: Complex, right: Real) -> Complex:
    """left @ stack @ right with real factors, as products of the real and the imaginary part."""
    product: Complex = (left @ stack.real @ right) + 1j * (left @ stack.imag @ right)
    return product
