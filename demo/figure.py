"""The figure of the demo: frames and their page, then the picture that was read and the AIR in each state."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from lightpage.demo.result import DemoResult
from lightpage.pictures import write_figure_png

_LEAST_BITS, _MOST_BITS = 0.0, 8.0
_PILOTS = "white"


def write_figure(result: DemoResult, path: Path) -> None:
    """Write the picture as PNG."""
    figure = Figure(figsize=(14, 10), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, 3)
    levels = result.code.levels
    frames = (("in-phase frame", result.frames.in_phase), ("quadrature frame", result.frames.quadrature))
    for axis, (name, frame) in zip(axes[0], frames, strict=False):
        axis.imshow(frame, cmap="gray")
        axis.set_title(name)
    shown = axes[0, 2].imshow(
        result.symbols, vmin=-0.5, vmax=levels - 0.5, cmap=colormaps["twilight"].resampled(levels)
    )
    axes[0, 2].set_title("their page, decoded")
    figure.colorbar(shown, ax=axes[0, :], shrink=0.8, label="symbol")
    for axis, phase in zip(axes[1], result.phases, strict=True):
        axis.imshow(phase.picture, vmin=0, vmax=255, cmap="gray")
        told = "every byte right" if phase.exact else f"{phase.lost} of {result.volume.file_pages} pages lost"
        unread = f"{phase.unread} of {phase.pages} pages unread, {phase.restored} restored"
        axis.set_title(f"{phase.name}: {unread};\n{told}")
    for axis, phase in zip(axes[2], result.phases, strict=True):
        # an unlikely symbol costs many bits; the colour tells losses apart, not their depth
        colours = colormaps["magma"].with_extremes(bad=_PILOTS)
        axis.imshow(np.clip(phase.air, _LEAST_BITS, _MOST_BITS), vmin=_LEAST_BITS, vmax=_MOST_BITS, cmap=colours)
        axis.set_title(f"{phase.name}: AIR {phase.air_bits_per_symbol:.2f} bit/symbol")
    pilots = Patch(facecolor=_PILOTS, edgecolor="black", label="pilots: known symbols, not counted")
    figure.legend(handles=[pilots], loc="outside lower center")
    figure.colorbar(axes[2, 0].images[0], ax=axes[2, :], shrink=0.8, label="AIR, bit/symbol")
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    write_figure_png(path, figure, dpi=110)
