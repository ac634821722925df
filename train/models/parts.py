"""Complex arithmetic on pairs of real tensors: exported graphs know no complex numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Parts = tuple[Tensor, Tensor]
"""Real and imaginary part, of the same shape."""


def stacked(values: NDArray[np.complexfloating]) -> Tensor:
    """Real and imaginary part of an array, [2, ...] float32: how a module keeps them."""
    return torch.from_numpy(np.stack([values.real, values.imag]).astype(np.float32))


def parts(stack: Tensor) -> Parts:
    """The two parts of what `stacked` made."""
    return stack[0], stack[1]


class Matrix(NamedTuple):
    """A complex matrix [..., m, n] for products that take three real ones and not four.

    Attributes:
        real: real part of the matrix.
        difference, sum: imaginary part less the real one, and both together.
    """

    real: Tensor
    difference: Tensor
    sum: Tensor

    @classmethod
    def of(cls, value: Parts) -> Matrix:
        """The matrix with these parts."""
        return cls(value[0], value[1] - value[0], value[0] + value[1])

    @property
    def adjoint(self) -> Matrix:
        """Conjugate transpose."""
        real, difference, both = (part.transpose(-1, -2) for part in self)
        return Matrix(real, -both, -difference)

    def times(self, right: Parts) -> Parts:
        """This matrix times another one."""
        both = self.real @ (right[0] + right[1])
        return both - self.sum @ right[1], both + self.difference @ right[0]

    def behind(self, left: Parts) -> Parts:
        """Another matrix times this one."""
        both = (left[0] + left[1]) @ self.real
        return both - left[1] @ self.sum, both + left[0] @ self.difference


def matmul(left: Parts, right: Parts) -> Parts:
    """Matrix product."""
    return left[0] @ right[0] - left[1] @ right[1], left[0] @ right[1] + left[1] @ right[0]


def multiply(left: Parts, right: Parts) -> Parts:
    """Product, element by element."""
    return left[0] * right[0] - left[1] * right[1], left[0] * right[1] + left[1] * right[0]


def multiply_conjugate(left: Parts, right: Parts) -> Parts:
    """Product with the complex conjugate of `right`, element by element."""
    return left[0] * right[0] + left[1] * right[1], left[1] * right[0] - left[0] * right[1]


def scaled(value: Parts, factor: Tensor) -> Parts:
    """Times a real factor that broadcasts."""
    return value[0] * factor, value[1] * factor


def phasor(phase: Tensor) -> Parts:
    """exp(i phase), of radians."""
    return torch.cos(phase), torch.sin(phase)


def conjugate(value: Parts) -> Parts:
    """The complex conjugate."""
    return value[0], -value[1]


def adjoint(matrix: Parts) -> Parts:
    """The conjugate transpose of a matrix [..., m, n]."""
    return matrix[0].transpose(-1, -2), -matrix[1].transpose(-1, -2)


def turned(stack: Tensor, by: Tensor | float) -> Tensor:
    """Real and imaginary part [2, ...] of what is turned by an angle that broadcasts."""
    angle = torch.as_tensor(by, dtype=stack.dtype, device=stack.device)
    return torch.stack(multiply(parts(stack), (torch.cos(angle), torch.sin(angle))))
