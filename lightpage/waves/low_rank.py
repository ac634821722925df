"""A smooth phase between two planes as a short sum of products, each of one factor for either plane."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.polynomial.legendre import leggauss, legvander
from numpy.typing import NDArray

from lightpage.waves.arrays import Arrays

Complex = NDArray[np.complexfloating]
Real = NDArray[np.floating]
Plane = tuple[Real, Real]
"""Sample places (x, y)."""
Phase = Callable[[Real, Real, Real, Real], Real]
"""(x, y) of one plane and (X, Y) of the other, arrays that broadcast, to radians."""

_SPARE_DEGREES = 12
"""Degrees beyond the steepest phase along an axis, in radians over half of the axis, that its polynomials need."""
_SPARE_IN_TILES = 4
"""Spare nodes where a tolerance of a percent serves."""
_PROBES = 9
"""Places along an axis that are asked how steep the phase is."""
_FLAT = 1e-9
"""Radians over half an axis below which a phase does not depend on it."""
SKETCH = 100
"""Random vectors with which the leading singular vectors of a large kernel are looked for at first."""
_POINT = 1e-300
"""Half length of an axis with one sample, metres."""


@dataclass(frozen=True)
class Expansion:
    """exp(i phase) on the samples of two planes, as terms whose products sum to it.

    The terms are the leading singular vectors among polynomials of the degrees that the phase needs.

    Attributes:
        first, second: polynomial coefficients of the terms, [R, y, x].
        first_axes, second_axes: the polynomials at the samples (y, x), [samples, degrees] each.
    """

    first: Complex
    second: Complex
    first_axes: tuple[Real, Real]
    second_axes: tuple[Real, Real]

    @classmethod
    def of(cls, phase: Phase, first: Plane, second: Plane, tolerance: float) -> Expansion:
        """Expand a phase.

        Args:
            phase: the phase.
            first, second: sample places (x, y) of both planes.
            tolerance: singular values below this share of the largest are dropped; the error is about as large.
        """
        axes = _axes(phase, first, second)
        kernel = _kernel(phase, axes)
        left = _leading_vectors(kernel, tolerance)
        return cls(
            first=_coefficients(left.T, *axes[:2]),
            second=_coefficients(left.conj().T @ kernel, *axes[2:]),
            first_axes=(axes[1].at_samples, axes[0].at_samples),
            second_axes=(axes[3].at_samples, axes[2].at_samples),
        )

    def on(self, arrays: Arrays) -> Expansion:
        """The expansion in arrays of another library."""

        def taken(values: Real) -> Any:
            return arrays.array(values.astype(np.complex64))

        first_y, first_x = map(taken, self.first_axes)
        second_y, second_x = map(taken, self.second_axes)
        first, second = arrays.array(self.first), arrays.array(self.second)
        return replace(
            self, first=first, second=second, first_axes=(first_y, first_x), second_axes=(second_y, second_x)
        )

    def terms(self, which: slice = slice(None)) -> Iterator[tuple[Complex, Complex]]:
        """Pairs of factors on the planes' samples, [y, x] each; an axis on which nothing depends has one sample."""
        for first, second in zip(self.first[which], self.second[which], strict=True):
            yield _values(first, self.first_axes), _values(second, self.second_axes)


@dataclass(frozen=True)
class Interpolation:
    """exp(i phase) on the samples of many alike tiles of a plane from its values at few nodes of each tile.

    It holds whatever the place on the other plane.

    Attributes:
        nodes: places (x, y) within each tile, [T, R, 2].
        weights: polynomial coefficients of each node's weight, [T, R, y, x].
        axes: the polynomials at a tile's samples (y, x).
    """

    nodes: Real
    weights: Complex
    axes: tuple[Real, Real]

    @classmethod
    def of(cls, phases: Sequence[Sequence[Phase]], tile: Plane, second: Plane, tolerance: float) -> Interpolation:
        """Choose as few nodes as reach the tolerance, the same number in each tile.

        Args:
            phases: some phases of each tile, for these and what lies between them, places told within the tile.
            tile: sample places of one tile.
            second: sample places of the other plane.
            tolerance: root mean square error over all tiles, as an integral over them.
        """
        by_axis = zip(*(_axes(phase, tile, second, _SPARE_IN_TILES) for some in phases for phase in some), strict=True)
        axes = [max(same, key=lambda axis: len(axis.nodes)) for same in by_axis]
        x, y = axes[:2]
        kernels = [np.concatenate([_kernel(phase, axes) for phase in some], axis=1) for some in phases]
        orders = [_pivots(kernel) for kernel in kernels]
        fits: list[tuple[Complex, float]] = []
        count = 0
        while count < len(kernels[0]):
            count += 1
            fits = [_least_squares(kernel, order[:count]) for kernel, order in zip(kernels, orders, strict=True)]
            if np.mean([error for _, error in fits]) <= tolerance**2:
                break
        root = np.sqrt(np.outer(x.weights, y.weights)).reshape(-1, 1)
        places = np.stack(np.meshgrid(x.places, y.places, indexing="ij"), axis=-1).reshape(-1, 2)
        chosen = [order[:count] for order in orders]
        weights = [_coefficients((fit * root[own, 0]).T, x, y) for (fit, _), own in zip(fits, chosen, strict=True)]
        return cls(places[np.stack(chosen)], np.stack(weights), (y.at_samples, x.at_samples))


def _pivots(kernel: Complex) -> NDArray[np.intp]:
    """Rows of a kernel, each the one that those before it say least of."""
    left, values, _ = np.linalg.svd(kernel, full_matrices=False)
    return np.asarray(scipy.linalg.qr((left * values).conj().T, pivoting=True, mode="r")[1])


def _least_squares(kernel: Complex, rows: NDArray[np.intp]) -> tuple[Complex, float]:
    """All rows of a kernel by some of them, [N, R], and the share of its power that they leave."""
    basis = kernel[rows]
    fit = kernel @ np.linalg.pinv(basis, rcond=1e-6)
    return fit, float(np.sum(np.abs(fit @ basis - kernel) ** 2) / np.sum(np.abs(kernel) ** 2))


@dataclass(frozen=True)
class _Axis:
    """Gauss's nodes on one axis, and Legendre's polynomials at its samples.

    Attributes:
        nodes, weights: nodes and weights of Gauss's quadrature from -1 to 1, [D].
        places: the nodes on the axis, [D].
        at_samples: polynomials there, [samples, D].
    """

    nodes: Real
    weights: Real
    places: Real
    at_samples: Real

    @classmethod
    def of(cls, samples: Real, steepest: float, spare: int) -> _Axis:
        degree = 0 if steepest < _FLAT else int(np.ceil(steepest)) + spare
        nodes, weights = leggauss(degree + 1)
        centre, half = _extent(samples)
        return cls(
            nodes, weights, centre + half * nodes, legvander((samples - centre) / half, degree).astype(np.float32)
        )

    @property
    def to_coefficients(self) -> Real:
        """Values at the nodes, times the roots of their weights, to coefficients of the polynomials, [D, D]."""
        count = len(self.nodes)
        return np.asarray((legvander(self.nodes, count - 1) * (np.arange(count) + 0.5)).T * np.sqrt(self.weights))


def _extent(samples: Real) -> tuple[float, float]:
    """Middle of an axis and half of its length."""
    return float(samples[0] + samples[-1]) / 2, max(float(np.ptp(samples)) / 2, _POINT)


def _axes(phase: Phase, first: Plane, second: Plane, spare: int = _SPARE_DEGREES) -> list[_Axis]:
    """Axes (x, y, X, Y) with as many nodes as the phase needs."""
    samples = [*first, *second]
    probes = np.linspace(-1, 1, _PROBES)
    places = [centre + half * probes for centre, half in map(_extent, samples)]
    seen = np.broadcast_to(phase(*np.meshgrid(*places, indexing="ij", sparse=True)), [_PROBES] * 4)
    slopes = np.gradient(seen, probes[1] - probes[0])
    return [_Axis.of(axis, float(np.abs(slope).max()), spare) for axis, slope in zip(samples, slopes, strict=True)]


def _kernel(phase: Phase, axes: list[_Axis]) -> Complex:
    """exp(i phase) at the nodes, times the roots of their weights, [nodes of the first plane, of the second]."""
    shape = [len(axis.nodes) for axis in axes]
    kernel = np.exp(
        1j * np.broadcast_to(phase(*np.meshgrid(*(a.places for a in axes), indexing="ij", sparse=True)), shape)
    )
    for number, axis in enumerate(axes):
        kernel = kernel * np.sqrt(axis.weights).reshape([-1 if other == number else 1 for other in range(4)])
    return np.asarray(kernel.reshape(shape[0] * shape[1], -1))


def _leading_vectors(kernel: Complex, tolerance: float) -> Complex:
    """Left singular vectors [N, R] whose values exceed a share of the largest value, largest first.

    Those of a large kernel are found among its products with random vectors (Halko, Martinsson and Tropp, SIAM Review
    53, 217, 2011), as many as it takes until the least of their values no longer counts.
    """
    rng, columns = np.random.default_rng(0), SKETCH
    while columns < min(kernel.shape):
        probed = np.linalg.qr(kernel @ rng.standard_normal((kernel.shape[1], columns)))[0]
        probed = np.linalg.qr(kernel.conj().T @ probed)[0]
        basis = np.linalg.qr(kernel @ probed)[0]
        left, values, _ = np.linalg.svd(basis.conj().T @ kernel, full_matrices=False)
        if values[-1] < tolerance / 10 * values[0]:
            return np.asarray(basis @ left[:, values > tolerance * values[0]])
        columns *= 2
    left, values, _ = np.linalg.svd(kernel, full_matrices=False)
    return np.asarray(left[:, values > tolerance * values[0]])


def _coefficients(values: Complex, x: _Axis, y: _Axis) -> Complex:
    """Values [R, x y] at the nodes of a plane, times the roots of weights, to coefficients [R, y, x]."""
    on_nodes = values.reshape(len(values), len(x.nodes), len(y.nodes)).swapaxes(1, 2)
    return np.asarray(y.to_coefficients @ on_nodes @ x.to_coefficients.T, dtype=np.complex64)


def _values(coefficients: Complex, axes: tuple[Real, Real]) -> Complex:
    y, x = map(_varying, axes)
    product: Complex = y @ coefficients @ x.T
    return product


def _varying(at_samples: Real) -> Real:
    """Polynomials at samples [samples, D]; at one of them if there is only the constant."""
    return at_samples if at_samples.shape[1] > 1 else at_samples[:1]
