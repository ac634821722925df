"""The decoder at symbol pitch: localizer and network, and refinements that make another pass."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

from lightpage.device.profile import Profile
from lightpage.train.models.field import FieldRecovery, Measured
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.localizers.coherent import CoherentLocalizer
from lightpage.train.models.localizers.wave import WaveLocalizer
from lightpage.train.models.network import Refiner, SymbolUNet
from lightpage.train.models.prediction import Prediction
from lightpage.train.models.waves import Real

COHERENT, WAVE = "coherent", "wave"
LOCALIZERS = (COHERENT, WAVE)
_BY_RAYS = ("places", "place_gradients", "phases")
_BY_WAVES = ("parameters",)


class SymbolDecoder(nn.Module):
    """Decoder from the cameras' measurements of one calibrated device to p.

    Args:
        profile: the nominal device.
        parameters: [P] fitted.
        localizer: name out of `LOCALIZERS`.
        choices: sizes, and how many refinements.
    """

    def __init__(self, profile: Profile, parameters: Real, localizer: str, choices: Hyperparameters) -> None:
        super().__init__()
        self.choices, grid = choices, choices.grid(profile)
        chosen = (
            choices.coherent_localizer(profile) if localizer == COHERENT else WaveLocalizer(profile, parameters, grid)
        )
        self.localizer: CoherentLocalizer | WaveLocalizer = chosen
        self.network = SymbolUNet(chosen.light_channels, choices.channels, choices.blocks, choices.depth)
        small = choices.of_refinement()
        self.prediction = Prediction(profile, parameters, grid) if choices.refinements else None
        unexplained = self.prediction.light_channels if self.prediction else 0
        self.refiners = nn.ModuleList(
            Refiner(unexplained, small.channels, small.blocks, small.depth) for _ in range(choices.refinements)
        )
        self._geometry = _BY_RAYS if localizer == COHERENT else _BY_WAVES
        waves = _BY_WAVES if localizer == WAVE or choices.refinements else ()
        self.table_inputs = ("positions", *(_BY_RAYS if localizer == COHERENT else ()), *waves)

    def forward(
        self, recovery: FieldRecovery, measured: Measured, table: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Decode one page.

        Args:
            recovery: field recovery of the same device.
            measured: measurements of the page.
            table: tensors of the sampling table by name, at least `table_inputs`.

        Returns:
            p [2, ny, nx]; field and what is left of the homodyne equations, [2, Gy, Gx], see `FieldRecovery`.
        """
        field, left = recovery.solve(measured)
        light = self.localizer(field, *(table[name] for name in self._geometry))
        positions = table["positions"][None]
        p = self.network(light.flatten(0, 2)[None], positions)
        for refiner in self.refiners:
            assert self.prediction is not None
            light = self.prediction(recovery, measured, field, p[0], table["parameters"])
            p = refiner(light.flatten(0, 2)[None], positions, p)
        return p[0], field, left
