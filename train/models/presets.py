"""Decoders to choose from by how much time a page they may take."""

from __future__ import annotations

from dataclasses import dataclass

from lightpage.train.models.decoder import COHERENT, WAVE
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.localizers.coherent import BILINEAR

REFLECTIONS = 4
"""Rounds to the field: as quick as six of descent, and a decoder by waves reads 0.19 bit more; 6 and 14 rounds bring
0.02 more."""
FAST, STANDARD, ACCURATE = "fast", "standard", "accurate"


@dataclass(frozen=True)
class Preset:
    """A decoder to choose.

    Attributes:
        localizer: localizer of the first pass, where none is chosen.
        choices: all else.
    """

    localizer: str
    choices: Hyperparameters


PRESETS = {
    FAST: Preset(
        COHERENT,
        Hyperparameters(channels=48, field_rounds=0, binning=2, field_step=3, samples=3, interpolation=BILINEAR),
    ),
    STANDARD: Preset(WAVE, Hyperparameters(reflections=REFLECTIONS)),
    ACCURATE: Preset(COHERENT, Hyperparameters(reflections=REFLECTIONS, refinements=1)),
}
"""Presets of one quick pass, one pass and two passes.

A pass by waves reads more than one by branches, and takes longer. Before a second pass that gain is lost again, and
branches are the quicker first pass. A second pass adds more than anything else does."""
