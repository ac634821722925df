"""Decoders to choose from by how much time a page they may take."""

from __future__ import annotations

from train.models.hyperparameters import Hyperparameters
from train.models.localizers.coherent import BILINEAR

FAST, STANDARD, ACCURATE = "fast", "standard", "accurate"
PRESETS = {
    FAST: Hyperparameters(channels=48, field_rounds=0, binning=2, field_step=3, samples=3, interpolation=BILINEAR),
    STANDARD: Hyperparameters(),
    ACCURATE: Hyperparameters(refinements=1),
}
"""One quick pass, one pass, two passes.

A second pass adds more than anything else does, and takes about as long as a first."""
