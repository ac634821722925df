"""Products whose constant factor is a real matrix on the right, also for complex light."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from lightpage.train.models.parts import Parts

PAD = 8
"""Numbers of a row come in multiples of so many: the fast kernels want rows of float16 that begin at 16 bytes."""
Tables = dict[str, Tensor]
"""Constants of a device, by name."""


def padded(value: Tensor, *axes: int) -> Tensor:
    """Zeros behind a tensor along some axes, counted from the last (-1), to a multiple of `PAD`."""
    widths = [0] * (-2 * min(axes))
    for axis in axes:
        widths[-2 * axis - 1] = -value.shape[axis] % PAD
    return functional.pad(value, widths) if any(widths) else value


def padded_parts(value: Parts, *axes: int) -> Parts:
    """The same of both parts."""
    return padded(value[0], *axes), padded(value[1], *axes)


def sizes(tensor: Tensor) -> list[int]:
    """The shape of a tensor whose number of pages is left open elsewhere: plain numbers, also while it is exported."""
    return [int(count) for count in tensor.shape]


def turned_product(light: Tensor, constant: Tensor) -> Tensor:
    """The transpose of each matrix [..., K, N] of light times a constant [K, M]: [..., N, M]."""
    return light.transpose(-1, -2) @ constant


def real_form(value: Parts, before: str = "rk", behind: str = "rk") -> Tensor:
    """The real matrix that does to pairs of reals what a complex one [..., K, M] does to numbers, [..., 2 K, 2 M].

    Args:
        value: the complex matrix; it stands on the right.
        before, behind: order of a pair's axis (r) and the numbers' (k) within its rows, and within its columns.
    """
    real, imaginary = value
    pairs = torch.stack([torch.stack([real, imaginary], -2), torch.stack([-imaginary, real], -2)], -4)
    return _ordered(pairs, before, behind)  # [..., r, k, r', k'] before


def with_phasor(value: Parts, before: str = "trk", behind: str = "rk") -> Tensor:
    """The same for light times a phasor's real part and times its imaginary one: t says which, [4 K, 2 M].

    So a phasor before a product costs one broadcast multiplication, and a sum over twice as many numbers.
    """
    real, imaginary = value
    turned = torch.stack([-imaginary, real], -2), torch.stack([-real, -imaginary], -2)
    straight = torch.stack([real, imaginary], -2), torch.stack([-imaginary, real], -2)
    pairs = torch.stack([torch.stack(straight, -4), torch.stack(turned, -4)], -5)
    return _ordered(pairs, before, behind)  # [..., t, r, k, r', k'] before


def _ordered(pairs: Tensor, before: str, behind: str) -> Tensor:
    """Axes [..., before, behind], each in the natural order, in the order that is asked for, and joined."""
    natural = "trk"[-len(before) :]
    lead = pairs.ndim - len(natural) - 2
    rows = [lead + natural.index(name) for name in before]
    columns = [lead + len(natural) + "rk".index(name) for name in behind]
    moved = pairs.permute(*range(lead), *rows, *columns)
    return moved.flatten(lead + len(natural)).flatten(lead, lead + len(natural) - 1)
