"""The decoder at symbol pitch: localizer and network, and refinements that look again."""

from __future__ import annotations

from torch import Tensor, nn

from optics.profile import Profile
from train.field import FieldRecovery, Measured
from train.fitting import Hyperparameters
from train.localizers.coherent import CoherentLocalizer
from train.localizers.wave import WaveLocalizer
from train.network import Refiner, SymbolUNet
from train.refinement import LIGHT_CHANNELS, Prediction
from train.waves import Real

COHERENT, WAVE = "coherent", "wave"
LOCALIZERS = (COHERENT, WAVE)
GEOMETRY = {COHERENT: ("places", "place_gradients", "phases"), WAVE: ()}
"""Tensors of the sampling table that a localizer takes beside the field."""


class SymbolDecoder(nn.Module):
    """What the cameras measured of one calibrated device to p.

    Args:
        profile: the nominal device.
        parameters: [P] fitted.
        localizer: of `LOCALIZERS`.
        choices: sizes, and how many refinements.
    """

    def __init__(self, profile: Profile, parameters: Real, localizer: str, choices: Hyperparameters) -> None:
        super().__init__()
        chosen = CoherentLocalizer(profile) if localizer == COHERENT else WaveLocalizer(profile, parameters)
        self.localizer: CoherentLocalizer | WaveLocalizer = chosen
        self.network = SymbolUNet(chosen.light_channels, choices.channels, choices.blocks, choices.levels)
        small = choices.of_refinement()
        self.refiners = nn.ModuleList(
            Refiner(LIGHT_CHANNELS, small.channels, small.blocks, small.levels) for _ in range(choices.refinements)
        )
        self.prediction = Prediction(profile, parameters) if choices.refinements else None

    def forward(
        self, recovery: FieldRecovery, measured: Measured, positions: Tensor, *geometry: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Decode one page.

        Args:
            recovery: of the same device.
            measured: of the page.
            positions: exit centroids over the pipe's width, [2, ny, nx].
            geometry: what the localizer takes, see `GEOMETRY`.

        Returns:
            p [2, ny, nx]; field and what is left of the homodyne equations, [2, Gy, Gx], see `FieldRecovery`.
        """
        field, left = recovery.solve(measured)
        p = self.network(self.localizer(field, *geometry).flatten(0, 2)[None], positions[None])
        for refiner in self.refiners:
            assert self.prediction is not None
            light = self.prediction(recovery, measured, field, p[0])
            p = refiner(light.flatten(0, 2)[None], positions[None], p)
        return p[0], field, left
