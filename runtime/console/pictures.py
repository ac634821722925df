"""Frames and confidences as PNG."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.temporary import settle_matplotlib

SIDE_PX = 900
"""Longest side of a picture of a frame."""
_SATURATED = (230, 60, 30)
_LEAST_MAP_PX = 320
"""A map of few symbols is enlarged to about this width."""


def frame_png(frame: NDArray[np.integer[Any]], bit_depth: int) -> bytes:
    """A frame, thinned to at most `SIDE_PX`, in grey up to full scale; saturated pixels are red.

    Args:
        frame: counts [row, column].
        bit_depth: bits of a count.
    """
    step = max(1, -(-max(frame.shape) // SIDE_PX))
    seen = frame[::step, ::step].astype(np.float64)
    top = 2**bit_depth - 1
    grey = np.clip(255 * seen / top, 0, 255).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=2)
    picture[seen >= top] = _SATURATED
    return _png(picture)


def confidence_png(confidence: NDArray[np.floating[Any]]) -> bytes:
    """Confidences [ny, nx] from 0, dark, to 1, bright, a block of pixels for each symbol."""
    settle_matplotlib()
    from matplotlib import colormaps  # takes long to import

    colours = (255 * colormaps["viridis"](np.clip(np.nan_to_num(confidence), 0, 1))[..., :3]).astype(np.uint8)
    size = max(1, _LEAST_MAP_PX // confidence.shape[1])
    return _png(np.kron(colours, np.ones((size, size, 1), np.uint8)))


def _png(picture: NDArray[np.uint8]) -> bytes:
    from PIL import Image  # only where somebody looks

    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(file, "PNG")
    return file.getvalue()
