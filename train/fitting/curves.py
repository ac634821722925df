"""Curves of a training run, as its TensorBoard files have them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

TENSORBOARD = "tensorboard"
"""Folder of a run's TensorBoard files."""

CURVES = ("train_nll", "train_air", "val_air", "angle_deg")
"""Quantities that training logs; the angle is that of a decoder by rays."""

Curve = Sequence[tuple[int, float]]
"""Values by step."""


def curves_of(run: Path) -> dict[str, Curve]:
    """The curves that a run logged, of `CURVES`; none where it has no TensorBoard files any more.

    An interrupted run repeats the steps behind its last checkpoint; what came later holds.
    """
    logs = run / TENSORBOARD
    if not any(logs.glob("events.*")):
        return {}
    events = EventAccumulator(str(logs), size_guidance={"scalars": 0})
    events.Reload()
    known = set(events.Tags()["scalars"])
    return {
        name: sorted({event.step: float(event.value) for event in events.Scalars(name)}.items())
        for name in CURVES
        if name in known
    }


def thinned(curve: Curve, points: int) -> Curve:
    """Reduce a curve to so many points at most: means over equal parts, each at its part's last step."""
    parts = np.array_split(np.array(curve), min(len(curve), points)) if curve else []
    return [(round(float(part[-1, 0])), float(part[:, 1].mean())) for part in parts]
