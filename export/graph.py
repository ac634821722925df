"""The whole decoder as one torch module: raw frames and sampling table in, p, phase and concentration out."""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lightpage.device.profile import Profile
from lightpage.recording.frame_pair import FramePair
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.field import FieldRecovery, relative_power
from lightpage.train.published.decoder import PublishedDecoder, sample_frames

FRAME_INPUTS = ("in_phase", "quadrature")
ANSWERS = ("p", "phase", "concentration")
"""What every decoder says."""
TABLE_INPUTS = ("reference_in_phase", "reference_quadrature", "registration", "homodyne")
"""Inputs of every decoder at symbol pitch that carry the calibrated table as their default and may be fed instead;
behind them come those of `CalibratedDevice.apart_inputs`, and of `SymbolDecoder.table_inputs`."""
PUBLISHED_TABLE_INPUTS = ("grid", "levels")
"""The same of a published decoder: where it samples the frames, and the references there."""
_SERIES = 15
"""Highest power in the series of an arc tangent."""
_LEAST = 1e-30
HALVED = ("network", "refiners")
"""Parts of a decoder at symbol pitch whose weights its file keeps as float16."""
OUTPUTS = (*ANSWERS, "residual", "field", "unexplained")
"""`unexplained` is what is left of the homodyne equations, [2, Gy, Gx]; `residual` its power over the field's."""


class DecoderGraph(nn.Module):
    """Field recovery and the decoder at symbol pitch behind each other.

    Args:
        profile: the nominal device.
        decoder: trained; the weights of its parts in `HALVED` are rounded to float16.
        kappa_scale: factor on p that makes its length a calibrated concentration.
        apart: see `CalibratedDevice.apart_inputs`.
    """

    outputs = OUTPUTS

    def __init__(
        self, profile: Profile, decoder: SymbolDecoder, kappa_scale: float, apart: tuple[str, ...] = ()
    ) -> None:
        super().__init__()
        self.recovery = decoder.choices.field_recovery(profile)
        self.decoder = decoder
        self.kappa_scale = kappa_scale
        with torch.no_grad():
            for parameter in itertools.chain(*(getattr(decoder, part).parameters() for part in HALVED)):
                parameter.copy_(parameter.half())
        self.apart = apart
        self.measured_by = (*TABLE_INPUTS, *apart)
        self.table_inputs = (*self.measured_by, *decoder.table_inputs)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Decode one pair: frames and `table_inputs` to `OUTPUTS`; see `lightpage.calibration.sampling_table`."""
        seen = len(FRAME_INPUTS) + len(self.measured_by)
        measured = self.recovery.measure(*tensors[:seen])
        table = dict(zip(self.decoder.table_inputs, tensors[seen:], strict=True))
        p, field, left = self.decoder(self.recovery, measured, table)
        return *answers(p * self.kappa_scale), relative_power(left, field), field, left


class FieldGraph(nn.Module):
    """Field recovery alone, for a re-fit that asks for many fields; all of its inputs are fed.

    Args:
        profile: the nominal device.
        reflections: rounds, see `FieldRecovery`.
        apart: see `CalibratedDevice.apart_inputs`.
    """

    outputs = ("field", "unexplained")

    def __init__(self, profile: Profile, reflections: int = 0, apart: tuple[str, ...] = ()) -> None:
        super().__init__()
        self.recovery = FieldRecovery(profile, reflections=reflections)
        self.table_inputs = (*TABLE_INPUTS, *apart)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Frames and `table_inputs` to field and what is left, see `FieldRecovery`."""
        return tuple(self.recovery(*tensors))


class PublishedGraph(nn.Module):
    """A published decoder with its sampling grid as a constant.

    Args:
        decoder: trained.
        kappa_scale: factor on p that makes its length a calibrated concentration.
    """

    outputs = ANSWERS

    def __init__(self, decoder: PublishedDecoder, kappa_scale: float) -> None:
        super().__init__()
        self.decoder = decoder
        self.kappa_scale = kappa_scale

    def forward(self, in_phase: Tensor, quadrature: Tensor, grid: Tensor, levels: Tensor) -> tuple[Tensor, ...]:
        """Decode one pair: `ANSWERS`, from where `grid` [2, h, w, 2] looks; the references there are `levels`."""
        seen = sample_frames(torch.stack([in_phase.to(torch.float32), quadrature.to(torch.float32)])[None], grid[None])
        return answers(self.decoder.read(seen, levels[None])[0] * self.kappa_scale)


def answers(p: Tensor, axis: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """p with its two numbers along an axis, its angle and its length."""
    x, y = p.unbind(axis)
    return p, angle(x, y), torch.sqrt(x * x + y * y)


def angle(x: Tensor, y: Tensor) -> Tensor:
    """atan2(y, x), radians, by operators that GPUs have kernels for: within 3e-7, and 0 where both are 0.

    The first octant's half angle has a tangent of at most tan(pi / 8), where few terms of the series will do.
    """
    across, along = y.abs(), x.abs()
    tangent = torch.minimum(across, along) / torch.clamp(torch.maximum(across, along), min=_LEAST)
    half = tangent / (1 + torch.sqrt(1 + tangent * tangent))
    square, series = half * half, torch.zeros_like(half)
    for power in range(_SERIES, 0, -2):
        series = 1 / power - square * series
    first = 2 * half * series
    quadrant = torch.where(across > along, math.pi / 2 - first, first)
    upper = torch.where(x < 0, math.pi - quadrant, quadrant)
    return torch.where(y < 0, -upper, upper)


def table_tensors(
    graph: DecoderGraph, table: dict[str, NDArray[np.float32]], references: FramePair
) -> dict[str, NDArray[np.generic]]:
    """The defaults of a graph's table inputs, in order."""
    tensors: dict[str, NDArray[np.generic]] = {
        "reference_in_phase": references.in_phase,
        "reference_quadrature": references.quadrature,
        **table,
    }
    return {name: tensors[name] for name in graph.table_inputs}


def published_tensors(decoder: PublishedDecoder) -> dict[str, NDArray[np.generic]]:
    """The defaults of `PUBLISHED_TABLE_INPUTS`, in order."""
    with torch.no_grad():
        grid = decoder.localizer.grid()
        levels = sample_frames(decoder.references[None], grid[None])[0]
    return dict(zip(PUBLISHED_TABLE_INPUTS, (grid.numpy(), levels.numpy()), strict=True))


Graph = DecoderGraph | PublishedGraph
"""Frames and then, in the order of their defaults, table tensors in; `outputs` out."""
