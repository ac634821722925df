"""Functions of tensors for formulas that take numpy or torch, by operators that runtimes have for float64."""

from __future__ import annotations

import math

import torch
from torch import Tensor

sin, cos, exp = torch.sin, torch.cos, torch.exp
_LEAST = 1e-9


def tan(angle: Tensor) -> Tensor:
    """The tangent of radians."""
    return torch.sin(angle) / torch.cos(angle)


def sinc(place: Tensor) -> Tensor:
    """sin(pi x) / (pi x)."""
    angle = math.pi * torch.where(place.abs() < _LEAST, torch.full_like(place, _LEAST), place)
    return torch.sin(angle) / angle
