"""The pipe: modes between its walls, from facet to facet."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

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

    Attributes:
        bases: sine modes along (y', x), by parity.
        half: phasors of half a step, [2, 2, Ky, Kx] by parity.
        cos, sin: cosine and sine of the turn of each pair of modes in a step, [Ky, Kx].
        steps: splitting steps.
        sheared: whether modes couple at all.
    """

    def __init__(self, geometry: WaveGeometry, cells: tuple[int, int], steps: int) -> None:
        self.sheared = abs(geometry.pipe_angle) > 0
        self.steps = steps if self.sheared else 1
        w, nk = geometry.pipe_width_m, geometry.refractive_index * geometry.wave_number
        dz = geometry.pipe_length_m / self.steps
        sides = w * (1 + geometry.pipe_height_relative), w
        self.bases = [
            _parity_basis(n, float(dz * (np.pi / side) ** 2 / (2 * nk))) for n, side in zip(cells, sides, strict=True)
        ]
        y, x = (basis.mode_numbers for basis in self.bases)
        detuning = mode_detuning(geometry, y[:, None, :, None], x[None, :, None, :])
        self.half = np.exp(0.5j * dz * detuning).astype(np.complex64)
        coupling = np.outer(self.bases[0].couplings, self.bases[1].couplings) / w**2
        coupling /= 1 + geometry.pipe_height_relative
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
