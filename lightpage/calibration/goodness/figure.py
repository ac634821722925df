"""Figure of a verdict: unexplained light over the page and over the exit facet."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from lightpage.calibration.goodness.verdict import Goodness, Map

_SIZE = (7.2, 3.1)
"""Inches."""
_COLUMNS = 110
"""Letters of a line of the title."""
_MOST = 30.0
"""Largest ratio of the colour scale."""


def goodness_figure(goodness: Goodness) -> Figure:
    """Draw the power of the residual over that of noise, over the page and over the pipe's exit facet."""
    figure = Figure(figsize=_SIZE, layout="constrained")
    FigureCanvasAgg(figure)
    page, facet = figure.subplots(1, 2, width_ratios=(1.5, 1))
    _draw(page, goodness.by_page, "over the page", None)
    shown = _draw(facet, goodness.by_facet, "over the exit facet", 1.0)
    bar = figure.colorbar(shown, ax=[page, facet], label="residual over noise", extend="max")
    bar.set_ticks([1, 3, 10, _MOST], labels=["1, noise", "3", "10", f"{_MOST:g}"])
    bar.ax.minorticks_off()
    what = f"{goodness.verdict}: about {goodness.bits_lost:.2f} bit a symbol lost"
    figure.suptitle("\n".join([what, *textwrap.wrap(goodness.cause, _COLUMNS)]), fontsize=9)
    return figure


def _draw(axis: Axes, values: Map, title: str, box: float | None) -> AxesImage:
    shown = axis.imshow(np.array(values), cmap="cividis", norm=LogNorm(1, _MOST), aspect="auto")
    axis.set_title(title, fontsize=9)
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_box_aspect(box or 0.64)
    for row, line in enumerate(values):
        for column, value in enumerate(line):
            axis.text(column, row, f"{value:.2g}", ha="center", va="center", fontsize=6, color=_ink(value))
    return shown


def _ink(value: float) -> str:
    return "white" if value < _MOST**0.5 else "black"
