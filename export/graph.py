"""The whole decoder as one torch module: raw frames and sampling table in, p, phase and concentration out."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from optics.profile import Profile
from train.field import FieldRecovery, relative_power
from train.localizers.coherent import CoherentLocalizer
from train.localizers.wave import WaveLocalizer
from train.network import SymbolUNet
from train.published.decoder import PublishedDecoder, sample_frames

FRAME_INPUTS = ("in_phase", "quadrature")
ANSWERS = ("p", "phase", "concentration")
"""What every decoder says."""
TABLE_INPUTS = (
    "reference_in_phase",
    "reference_quadrature",
    "registration",
    "homodyne",
    "places",
    "place_gradients",
    "phases",
    "positions",
)
"""Inputs that carry the calibrated table as their default and may be fed instead."""
WAVE_TABLE_INPUTS = tuple(name for name in TABLE_INPUTS if name not in ("places", "place_gradients", "phases"))
"""The same of a decoder by waves, which holds the pipe's geometry itself."""
PUBLISHED_TABLE_INPUTS = ("grid", "levels")
"""The same of a published decoder: where it samples the frames, and the references there."""
OUTPUTS = (*ANSWERS, "residual", "field", "unexplained")
"""`unexplained` is what is left of the homodyne equations, [2, Gy, Gx]; `residual` its power over the field's."""


class DecoderGraph(nn.Module):
    """Field recovery, coherent localizer and network behind each other.

    Args:
        profile: the nominal device.
        network: trained.
        kappa_scale: factor on p that makes its length an honest concentration.
    """

    outputs = OUTPUTS

    def __init__(self, profile: Profile, network: SymbolUNet, kappa_scale: float) -> None:
        super().__init__()
        self.recovery = FieldRecovery(profile)
        self.localizer = CoherentLocalizer(profile)
        self.network = network
        self.kappa_scale = kappa_scale

    def forward(
        self,
        in_phase: Tensor,
        quadrature: Tensor,
        reference_in_phase: Tensor,
        reference_quadrature: Tensor,
        registration: Tensor,
        homodyne: Tensor,
        places: Tensor,
        place_gradients: Tensor,
        phases: Tensor,
        positions: Tensor,
    ) -> tuple[Tensor, ...]:
        """Decode one pair; see `OUTPUTS` and, for the table, `optics.registration.table`."""
        frames = (in_phase, quadrature, reference_in_phase, reference_quadrature)
        field, left = self.recovery(*(frame.to(torch.float32) for frame in frames), registration, homodyne)
        light = self.localizer(field, places, place_gradients, phases)
        p = self.network(light.flatten(0, 2)[None], positions[None])[0] * self.kappa_scale
        return *_answers(p), relative_power(left, field), field, left


class WaveGraph(nn.Module):
    """Field recovery, wave localizer and network behind each other; the geometry is a constant of the graph.

    Args:
        profile: the nominal device.
        localizer: of the fitted device.
        network: trained.
        kappa_scale: factor on p that makes its length an honest concentration.
    """

    outputs = OUTPUTS

    def __init__(self, profile: Profile, localizer: WaveLocalizer, network: SymbolUNet, kappa_scale: float) -> None:
        super().__init__()
        self.recovery = FieldRecovery(profile)
        self.localizer = localizer
        self.network = network
        self.kappa_scale = kappa_scale

    def forward(
        self,
        in_phase: Tensor,
        quadrature: Tensor,
        reference_in_phase: Tensor,
        reference_quadrature: Tensor,
        registration: Tensor,
        homodyne: Tensor,
        positions: Tensor,
    ) -> tuple[Tensor, ...]:
        """Decode one pair; see `OUTPUTS` and, for the table, `optics.registration.table`."""
        frames = (in_phase, quadrature, reference_in_phase, reference_quadrature)
        field, left = self.recovery(*(frame.to(torch.float32) for frame in frames), registration, homodyne)
        p = self.network(self.localizer(field).flatten(0, 2)[None], positions[None])[0] * self.kappa_scale
        return *_answers(p), relative_power(left, field), field, left


class PublishedGraph(nn.Module):
    """A published decoder with its sampling grid as a constant.

    Args:
        decoder: trained.
        kappa_scale: factor on p that makes its length an honest concentration.
    """

    outputs = ANSWERS

    def __init__(self, decoder: PublishedDecoder, kappa_scale: float) -> None:
        super().__init__()
        self.decoder = decoder
        self.kappa_scale = kappa_scale

    def forward(self, in_phase: Tensor, quadrature: Tensor, grid: Tensor, levels: Tensor) -> tuple[Tensor, ...]:
        """Decode one pair: `ANSWERS`, from where `grid` [2, h, w, 2] looks; the references there are `levels`."""
        seen = sample_frames(torch.stack([in_phase, quadrature])[None].to(torch.float32), grid[None])
        return _answers(self.decoder.read(seen, levels[None])[0] * self.kappa_scale)


def _answers(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """p [2, ny, nx], its angle and its length."""
    return p, torch.atan2(p[1], p[0]), torch.sqrt((p * p).sum(0))


def table_tensors(
    table: dict[str, NDArray[np.float32]],
    in_phase: NDArray[np.integer],
    quadrature: NDArray[np.integer],
    names: tuple[str, ...] = TABLE_INPUTS,
) -> dict[str, NDArray[np.generic]]:
    """The defaults of `names`, in order: from the sampling table and the reference-only frames."""
    tensors = {"reference_in_phase": in_phase, "reference_quadrature": quadrature, **table}
    return {name: tensors[name] for name in names}


def published_tensors(decoder: PublishedDecoder) -> dict[str, NDArray[np.generic]]:
    """The defaults of `PUBLISHED_TABLE_INPUTS`, in order."""
    with torch.no_grad():
        grid = decoder.localizer.grid()
        levels = sample_frames(decoder.references[None], grid[None])[0]
    return dict(zip(PUBLISHED_TABLE_INPUTS, (grid.numpy(), levels.numpy()), strict=True))


Graph = DecoderGraph | WaveGraph | PublishedGraph
"""Frames and then, in the order of their defaults, table tensors in; `outputs` out."""
