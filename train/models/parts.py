"""Complex arithmetic on pairs of real tensors: exported graphs know no complex numbers."""

from __future__ import annotations

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


def matmul(left: Parts, right: Parts) -> Parts:
    """Matrix product."""
    return left[0] @ right[0] - left[1] @ right[1], left[0] @ right[1] + left[1] @ right[0]


def multiply(left: Parts, right: Parts) -> Parts:
    """Product, element by element."""
    return left[0] * right[0] - left[1] * right[1], left[0] * right[1] + left[1] * right[0]


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
