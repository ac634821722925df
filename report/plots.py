"""Draws what users hold: a page's frames, a recording's page beside its references, a page's symbols."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.client.answers import RemotePage
from lightpage.runtime.model.decoding.page import DecodedPage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PANEL_IN = (4.2, 3.2)


def plot(shown: Recording | FramePair | DecodedPage | RemotePage, page: int = 0) -> Figure:
    """Draw a frame pair, a recording's page with its references, or a decoded page's symbols and confidence.

    Args:
        shown: what is drawn.
        page: which one of a recording.

    Returns:
        A figure, which a notebook shows and `savefig` writes.

    Raises:
        InvalidInputError: something else, or no such page.
    """
    from matplotlib.figure import Figure

    panels = _panels(shown, page)
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure((_PANEL_IN[0] * columns, _PANEL_IN[1] * rows), layout="constrained")
    for axes, (title, image, limits) in zip(figure.subplots(rows, columns).flat, panels, strict=True):
        cyclic = title.startswith("symbols")
        drawn = axes.imshow(image, cmap="twilight" if cyclic else "viridis", vmin=limits[0], vmax=limits[1])
        axes.set_title(title)
        axes.set_axis_off()
        figure.colorbar(drawn, ax=axes)
    return figure


_Panel = tuple[str, NDArray[Any], tuple[float | None, float | None]]


def _panels(shown: object, page: int) -> list[_Panel]:
    match shown:
        case FramePair():
            return _frames(shown)
        case Recording():
            return _frames(shown.frames(page), f", page {page}") + _frames(shown.references(), " reference")
        case DecodedPage() | RemotePage():
            symbols = f"symbols of {shown.levels} levels"
            return [(symbols, shown.symbols, (0, shown.levels)), ("confidence", shown.confidence, (0, 1))]
    raise InvalidInputError("plot", type(shown).__name__, "a Recording, a FramePair, or a decoded page")


def _frames(pair: FramePair, what: str = "") -> list[_Panel]:
    frames = ("in-phase", pair.in_phase), ("quadrature", pair.quadrature)
    return [(f"{name}{what} (counts)", frame, (None, None)) for name, frame in frames]
