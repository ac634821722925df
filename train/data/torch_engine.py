"""The simulator's engine for a GPU: torch, whose light on a CPU is that of numpy within float32 rounding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from lightpage.errors import InvalidInputError

_POLE = 3**0.5 - 2
"""Pole of the cubic B-spline's prefilter (Unser, IEEE Signal Processing Magazine 16(6), 22, 1999)."""
_REACH = 14
"""Samples after which the prefilter's response has fallen below the rounding of float32."""
_SINGLE = {torch.float64: torch.float32, torch.complex128: torch.complex64}
_LARGEST_SEED = 2**63


def torch_device(compute: str) -> torch.device:
    """The device `cpu`, `cuda` or `cuda:N`.

    Raises:
        InvalidInputError: another name, or a device that this machine or this torch has not.
    """
    kind, colon, number = compute.partition(":")
    if kind not in ("cpu", "cuda") or (colon and not (kind == "cuda" and number.isdecimal())):
        raise InvalidInputError("--compute", compute, "cpu, cuda or cuda:N")
    if kind == "cuda":
        there = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if not there:
            built = f"torch {torch.__version__} " + ("finds none" if torch.version.cuda else "is built without CUDA")
            raise InvalidInputError("--compute", f"{compute} without a GPU: {built}", "cpu, or a machine with one")
        if int(number or 0) >= there:
            raise InvalidInputError("--compute", compute, f"cuda:0 to cuda:{there - 1}, this machine's")
    return torch.device(kind, int(number)) if number else torch.device(kind)


class TorchNoise:
    """Random numbers on a device, under the names of numpy's generator.

    Args:
        device: the device.
        seed: whole numbers that name the stream.
    """

    def __init__(self, device: torch.device, seed: Sequence[int]) -> None:
        self._generator = torch.Generator(device)
        state = np.random.SeedSequence(list(seed)).generate_state(1, np.uint64)[0]
        self._generator.manual_seed(int(state) % _LARGEST_SEED)

    def standard_normal(self, shape: Sequence[int], dtype: object = None) -> Tensor:
        """Numbers of unit variance, float32 whatever the type."""
        return torch.randn(tuple(shape), generator=self._generator, device=self._generator.device)

    def poisson(self, expected: Tensor) -> Tensor:
        """Counts with these expectations, float32."""
        return torch.poisson(expected, generator=self._generator)


class TorchEngine:
    """See `lightpage.simulator.engine.Engine`.

    Args:
        compute: name of a device.

    Attributes:
        device: the device.

    Raises:
        InvalidInputError: no such device.
    """

    xp: ModuleType = torch

    def __init__(self, compute: str) -> None:
        self.device = torch_device(compute)

    def array(self, values: NDArray[Any]) -> Tensor:
        """See `Arrays`: a tensor in single precision."""
        tensor = torch.from_numpy(np.ascontiguousarray(values))
        return tensor.to(self.device, _SINGLE.get(tensor.dtype, tensor.dtype))

    def exact(self, values: NDArray[Any]) -> Tensor:
        """See `Arrays`."""
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

    def complex64(self, values: Tensor) -> Tensor:
        """See `Arrays`."""
        return values.to(torch.complex64)

    def sum(self, function: Callable[[slice], Tensor], count: int) -> Tensor:
        """Add up all at once: the device computes beside itself."""
        return function(slice(0, count))

    def generator(self, seed: Sequence[int]) -> TorchNoise:
        """See `Engine`."""
        return TorchNoise(self.device, seed)

    def counts(self, values: Tensor, bit_depth: int) -> Tensor:
        """See `Engine`."""
        return values.to(torch.uint8 if bit_depth == 8 else torch.uint16)

    def to_numpy(self, values: Tensor) -> NDArray[Any]:
        """See `Engine`."""
        return np.asarray(values.cpu().numpy())

    @torch.no_grad()
    def spline(self, image: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """See `Engine`: a prefilter of two convolutions, then four samples along either axis."""
        padded = functional.pad(image.float()[None, None], (2 * _REACH,) * 4, mode="replicate")
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # 10 bits would be seen
            coefficients = functional.conv2d(functional.conv2d(padded, self._prefilter.mT), self._prefilter)[0, 0]
        height, width = coefficients.shape
        (top, down), (left, across) = (
            _nearest(places.clip(-1, count), limit - 4, _REACH)
            for places, count, limit in ((rows, image.shape[0], height), (columns, image.shape[1], width))
        )
        flat, total = coefficients.flatten(), torch.zeros(rows.shape, device=self.device)
        first = top * width + left
        for row, weight in enumerate(_cubic(down)):
            line = torch.zeros_like(total)
            for column, share in enumerate(_cubic(across)):
                line.addcmul_(share, flat[first + (row * width + column)])
            total.addcmul_(weight, line)
        return total

    @cached_property
    def _prefilter(self) -> Tensor:
        """Response of the cubic B-spline's prefilter, [1, 1, 1, taps]."""
        away = torch.arange(-_REACH, _REACH + 1, dtype=torch.float64).abs()
        response = -6 * _POLE / (1 - _POLE**2) * _POLE**away
        return response.float().to(self.device)[None, None, None]


def _nearest(places: Tensor, last: int, padding: int) -> tuple[Tensor, Tensor]:
    """First of the four samples about each place, of a line that was padded, and how far beyond the second it lies."""
    whole = places.floor()
    return (whole.long() + (padding - 1)).clip(0, last), (places - whole).float()


def _cubic(t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weights of the cubic B-spline at four samples, for places t beyond the second."""
    back = 1 - t
    middle, after = (2 / 3 - x**2 * (1 - x / 2) for x in (t, back))
    return back**3 / 6, middle, after, t**3 / 6
