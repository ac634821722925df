"""The picture of the demo: frames, confidence, and the AIR's map in each state of the device."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from runtime.demo import DemoResult

_LEAST_BITS, _MOST_BITS = 0.0, 6.0


def write_figure(result: DemoResult, path: Path) -> None:
    """Write the picture as PNG."""
    figure = Figure(figsize=(14, 7), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    for axis, frame, name in zip(axes[0], result.frames, ("in-phase frame", "quadrature frame"), strict=False):
        axis.imshow(frame, cmap="gray")
        axis.set_title(name)
    shown = axes[0, 2].imshow(result.phases[0].confidence, vmin=0, vmax=1, cmap="viridis")
    axes[0, 2].set_title("confidence of each symbol, as calibrated")
    figure.colorbar(shown, ax=axes[0, 2], shrink=0.8)
    for axis, phase in zip(axes[1], result.phases, strict=True):
        # an unlikely symbol costs many bits; the colour tells losses apart, not their depth
        bits = np.clip(phase.air, _LEAST_BITS, _MOST_BITS)
        shown = axis.imshow(bits, vmin=_LEAST_BITS, vmax=_MOST_BITS, cmap="magma")
        axis.set_title(f"{phase.name}: AIR {phase.air_bits_per_symbol:.2f} bit/symbol")
    figure.colorbar(shown, ax=axes[1, :], shrink=0.8, label="AIR, bit/symbol")
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    # no date in the file: the same demo gives the same bytes
    figure.savefig(path, dpi=110, metadata={"Software": None})
