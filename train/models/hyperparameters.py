"""Hyperparameters of a training run."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lightpage.device.profile import Profile
from lightpage.train.models.field import ROUNDS, FieldRecovery
from lightpage.train.models.localizers.coherent import BICUBIC, CoherentLocalizer
from lightpage.waves.grid import GRID_STEP_PX, FieldGrid, field_grid

_REFINEMENT_STEPS = 0.25
"""Steps of a refinement's network over those of the first."""

_FEWEST_STEPS = 2
"""Fewest steps in which a learning rate can rise and fall."""


@dataclass(frozen=True)
class Hyperparameters:
    """Everything that a training run chooses.

    Attributes:
        channels, blocks, depth: size of the network, see `SymbolUNet`.
        refinements: further passes of the decoder, see `lightpage.train.trainers.refinement`.
        field_rounds, reflections, binning: settings of the field's recovery, see
            `lightpage.train.models.field.FieldRecovery`.
        field_step: pitch of the common grid, camera pixels.
        samples, interpolation: see `CoherentLocalizer`.
        steps: optimiser steps.
        batch: pages a step, or patches of large ones.
        patch: symbols along a patch's edge; smaller pages are trained on whole.
        learning_rate: peak of the one-cycle schedule.
        weight_decay: weight decay of AdamW.
        seed: seed of initial weights, batches and rotations.
        precision: see `lightpage.train.fitting.precision`.
    """

    channels: int = 96
    blocks: int = 2
    depth: int = 0
    refinements: int = 0
    field_rounds: int = ROUNDS
    reflections: int = 0
    binning: int = 1
    field_step: int = GRID_STEP_PX
    samples: int = 0
    interpolation: str = BICUBIC
    steps: int = 6000
    batch: int = 4
    patch: int = 96
    learning_rate: float = 4e-3
    weight_decay: float = 1e-3
    seed: int = 0
    precision: str = "auto"

    @property
    def first_pass(self) -> str:
        """Key of all settings that the features of the first pass depend on."""
        reflections = f"{self.reflections} reflections " if self.reflections else ""
        rest = f"{self.binning} {self.field_step} {self.samples} {self.interpolation}"
        return f"{reflections}{self.field_rounds} {rest}"

    def grid(self, profile: Profile) -> FieldGrid:
        """The common grid of these choices."""
        return field_grid(profile, self.field_step)

    def field_recovery(self, profile: Profile, *, with_signal_power: bool = True) -> FieldRecovery:
        """The field's recovery of these choices."""
        return FieldRecovery(
            profile,
            with_signal_power=with_signal_power,
            rounds=self.field_rounds,
            reflections=self.reflections,
            binning=self.binning,
            grid=self.grid(profile),
        )

    def coherent_localizer(self, profile: Profile) -> CoherentLocalizer:
        """The localizer of these choices."""
        return CoherentLocalizer(profile, self.samples, self.interpolation, self.grid(profile))

    def drawn(self, page_shape: tuple[int, int]) -> float:
        """Pages that all steps together are shown, a patch counting for its share of one."""
        share = math.prod(min(count, self.patch) / count for count in page_shape)
        return self.steps * self.batch * share

    def of_refinement(self) -> Hyperparameters:
        """The choices for a refinement's network, which starts from a good estimate and sees little light."""
        steps = max(_FEWEST_STEPS, round(_REFINEMENT_STEPS * self.steps))
        return replace(self, channels=max(1, self.channels * 2 // 3), blocks=1, depth=0, refinements=0, steps=steps)
