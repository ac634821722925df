"""The picture that the demo stores: grey levels as plain bytes, so that what is lost of it can be seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ROWS, COLUMNS = 240, 250


def picture() -> NDArray[np.uint8]:
    """Rings of a zone plate, folded at two walls as the light-pipe folds a page, and a name: uint8 [240, 250]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    y, x = np.mgrid[-1 : 1 : ROWS * 1j, -1 : 1 : COLUMNS * 1j]
    folded_x, folded_y = (np.abs(np.abs(axis) - 0.7) for axis in (x, y))
    rings = np.cos(60 * (folded_x**2 + folded_y**2)) * (0.4 + 0.6 * (1 - (x**2 + y**2) / 2))
    figure = Figure(figsize=(COLUMNS / 100, ROWS / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    figure.text(0.5, 0.5, "Lightpage", ha="center", va="center", fontsize=28, weight="bold")
    canvas.draw()  # type: ignore[no-untyped-call]
    text = np.asarray(canvas.buffer_rgba())[..., 0] < 128  # type: ignore[no-untyped-call]
    grey = np.where(text, 255, 100 + 80 * rings)
    return np.asarray(np.clip(grey, 0, 255), np.uint8)
