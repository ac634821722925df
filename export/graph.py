"""The whole decoder as one torch module: raw frames and sampling table in, p, phase and concentration out."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from optics.profile import Profile
from train.field import FieldRecovery, relative_power
from train.localizers.coherent import CoherentLocalizer
from train.network import SymbolUNet

FRAME_INPUTS = ("in_phase", "quadrature")
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
OUTPUTS = ("p", "phase", "concentration", "residual", "field", "unexplained")
"""`unexplained` is what is left of the homodyne equations, [2, Gy, Gx]; `residual` its power over the field's."""


class DecoderGraph(nn.Module):
    """Field recovery, coherent localizer and network behind each other.

    Args:
        profile: the nominal device.
        network: trained.
        kappa_scale: factor on p that makes its length an honest concentration.
    """

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
        field, left = self.recovery(
            in_phase.to(torch.float32),
            quadrature.to(torch.float32),
            reference_in_phase.to(torch.float32),
            reference_quadrature.to(torch.float32),
            registration,
            homodyne,
        )
        light = self.localizer(field, places, place_gradients, phases)
        p = self.network(light.flatten(0, 2)[None], positions[None])[0] * self.kappa_scale
        phase = torch.atan2(p[1], p[0])
        concentration = torch.sqrt((p * p).sum(0))
        return p, phase, concentration, relative_power(left, field), field, left


def table_tensors(
    table: dict[str, NDArray[np.float32]], in_phase: NDArray[np.integer], quadrature: NDArray[np.integer]
) -> dict[str, NDArray[np.generic]]:
    """The defaults of `TABLE_INPUTS`: the sampling table and the reference-only frames."""
    return {"reference_in_phase": in_phase, "reference_quadrature": quadrature, **table}
