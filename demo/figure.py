"""The figure of the demo: frames and their page, then the picture that was read and the AIR in each state."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from lightpage.demo.result import DemoResult, Phase
from lightpage.pictures import write_figure_png

_LOWEST_PERCENT = 2
"""Share of symbols below the scale of AIR: its few worst symbols would hide what differs."""
_BRIGHTEST_PERCENT = 99
"""Share of pixels that the scale of frames shows: a few bright ones would leave the others dark."""
_SHADES = 32
"""Shades of a map or frame: few colours make a small file."""
_PILOTS = "white"


def write_figure(result: DemoResult, path: Path) -> None:
    """Write the picture as PNG."""
    figure = Figure(figsize=(14, 11), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, 3)
    levels = result.code.levels
    frames = (("in-phase frame", result.frames.in_phase), ("quadrature frame", result.frames.quadrature))
    for axis, (name, frame) in zip(axes[0], frames, strict=False):
        axis.imshow(frame, cmap=colormaps["gray"].resampled(_SHADES), vmax=np.percentile(frame, _BRIGHTEST_PERCENT))
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
    maps = [phase.air for phase in result.phases]
    # an unlikely symbol costs many bits; the colour tells losses apart, not their depth
    least, most = np.nanpercentile(maps, _LOWEST_PERCENT), np.nanmax(maps)
    colours = colormaps["magma"].resampled(_SHADES).with_extremes(bad=_PILOTS)
    for axis, phase in zip(axes[2], result.phases, strict=True):
        axis.imshow(phase.air, vmin=least, vmax=most, cmap=colours, interpolation="nearest")
        axis.set_title(f"{phase.name}: AIR {phase.air_bits_per_symbol:.2f} bit/symbol")
    pilots = Patch(facecolor=_PILOTS, edgecolor="black", label="pilots: known symbols, not counted")
    figure.legend(handles=[pilots], loc="outside lower right")
    figure.colorbar(axes[2, 0].images[0], ax=axes[2, :], shrink=0.8, label="AIR, bit/symbol", extend="min")
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
