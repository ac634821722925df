"""The figure of the demo: frames and their page, then the picture that was read and the AIR in each state."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lightpage.demo.result import DemoResult, Phase
from lightpage.metrics.measures import SMOOTH, smoothed
from lightpage.pictures import write_figure_png

_LOWEST_PERCENT = 2
"""Share of symbols below the scale of AIR: its few worst symbols would hide what differs."""
_GREY_PERCENT = (1, 98)
"""Percentiles of a frame that are black and white: a few bright pixels would leave the others dark."""
_SHADES = 32
"""Shades of a map or frame: few colours make a small file."""


def write_figure(result: DemoResult, path: Path) -> None:
    """Write the picture as PNG."""
    figure = Figure(figsize=(14, 11.3), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, 3)
    levels = result.code.levels
    frames = (("in-phase frame", result.frames.in_phase), ("quadrature frame", result.frames.quadrature))
    for axis, (name, frame) in zip(axes[0], frames, strict=False):
        black, white = np.percentile(frame, _GREY_PERCENT)
        axis.imshow(frame, cmap=colormaps["gray"].resampled(_SHADES), vmin=black, vmax=white)
        axis.set_title(name)
    shown = axes[0, 2].imshow(
        result.symbols,
        vmin=-0.5,
        vmax=levels - 0.5,
        cmap=colormaps["twilight"].resampled(levels),
        interpolation="nearest",
    )
    axes[0, 2].set_title("their page, decoded")
    figure.colorbar(shown, ax=axes[0, :], shrink=0.8, label="symbol")
    for axis, phase in zip(axes[1], result.phases, strict=True):
        assert phase.picture is not None  # it was read
        axis.imshow(phase.picture, vmin=0, vmax=255, cmap="gray")
        axis.set_title(f"{phase.name}: {_read(result, phase)}")
        if phase.lost == result.volume.file_pages:
            middle = np.array(phase.picture.shape[::-1]) / 2
            axis.text(*middle, "nothing of the picture", color="white", ha="center", va="center", fontsize=14)
    maps = [smoothed(phase.air) for phase in result.phases]
    # an unlikely symbol costs many bits; the colour tells losses apart, not their depth
    least, most = np.percentile(maps, _LOWEST_PERCENT), np.max(maps)
    colours = colormaps["magma"].resampled(_SHADES)
    for axis, phase, shown in zip(axes[2], result.phases, maps, strict=True):
        axis.imshow(shown, vmin=least, vmax=most, cmap=colours, interpolation="nearest")
        axis.set_title(f"{phase.name}: AIR {phase.air_bits_per_symbol:.2f} bit/symbol")
    figure.colorbar(
        axes[2, 0].images[0],
        ax=axes[2, :],
        shrink=0.8,
        label=f"AIR, bit/symbol, mean of {SMOOTH} x {SMOOTH}",
        extend="min",
    )
    figure.suptitle("\n".join(result.story()), fontsize=13)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    write_figure_png(path, figure, dpi=110)


def _read(result: DemoResult, phase: Phase) -> str:
    """Describe how many pages were read in a state, and what they gave."""
    told = "every byte right" if phase.exact else f"{phase.lost} of {result.volume.file_pages} data pages lost"
    restored = f"{phase.restored} restored by parity, " if phase.restored else ""
    return f"{phase.pages - phase.unread} of {phase.pages} pages read\n{restored}{told}"
