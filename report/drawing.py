"""Style of a report's figures: small, on white, as data that a page carries in itself."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_SIZE, _IMAGE_SIZE = (4.8, 3.5), (4.8, 3.9)
"""Inches. All figures equally wide, so that their letters are alike on the page."""
_DOTS = 180
"""Per inch, of images."""
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "lightpage",
}
"""Settings of matplotlib, in which all of these are to be drawn (`matplotlib.rc_context`)."""
BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#666666"
"""Okabe and Ito's, told apart without red and green."""


@dataclass(frozen=True)
class Picture:
    """A figure.

    Attributes:
        uri: the image itself, as a data URI.
        alt: content of the figure, for those who cannot see it.
        caption: caption: what to see in the figure.
    """

    uri: str
    alt: str
    caption: str


def new_figure(*, image: bool = False) -> Figure:
    """An empty figure, for an image or for lines."""
    figure = Figure(figsize=_IMAGE_SIZE if image else _SIZE, layout="compressed" if image else "constrained")
    FigureCanvasAgg(figure)
    return figure


def one_axis(*, image: bool = False) -> tuple[Figure, Axes]:
    """A figure with one pair of axes in it."""
    figure = new_figure(image=image)
    axis = figure.subplots()
    if image:
        axis.spines[:].set_visible(False)
    return figure, axis


def as_picture(figure: Figure, alt: str, caption: str, *, image: bool = False) -> Picture:
    """The figure as a data URI: PNG for images, SVG for lines. The same figure gives the same bytes."""
    kind, mime = ("png", "image/png") if image else ("svg", "image/svg+xml")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=_DOTS, metadata={"Software": None} if image else {"Date": None})
    return Picture(f"data:{mime};base64,{base64.b64encode(buffer.getvalue()).decode()}", alt, caption)
