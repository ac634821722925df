"""Frames and estimated AIR as PNG."""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.temporary import settle_matplotlib
from lightpage.von_mises import information

SIDE_PX = 900
"""Longest side of a picture of a frame."""
_SATURATED = (230, 60, 30)
_WHITE_PERCENT = 99.5
"""Percentile of a frame's counts that is white: full scale would leave most frames dark."""
_LEAST_MAP_PX = 320
"""A map of few symbols is enlarged to about this width."""
AIR_BITS = (-2.0, 0.5)
"""Ends of the colours of a map of AIR, beside what is usual: below, the code soon fails; above, symbols are rare."""


def frame_png(frame: NDArray[np.integer[Any]], bit_depth: int) -> bytes:
    """A frame, thinned to at most `SIDE_PX`, brightened at most twentyfold; saturated pixels are red.

    Args:
        frame: counts [row, column].
        bit_depth: bits of a count.
    """
    step = max(1, -(-max(frame.shape) // SIDE_PX))
    seen = frame[::step, ::step].astype(np.float64)
    top = 2**bit_depth - 1
    white = max(top / 20, float(np.percentile(seen, _WHITE_PERCENT)))
    grey = np.clip(255 * seen / white, 0, 255).astype(np.uint8)
    return _png(np.where((seen < top)[..., None], grey[..., None], np.array(_SATURATED, np.uint8)))


def air_png(concentration: NDArray[np.floating[Any]], usual: float | None) -> bytes:
    """Return the estimated AIR of each symbol against what is usual, a block of pixels for each symbol.

    Args:
        concentration: von Mises kappa [ny, nx].
        usual: estimated AIR of a usual page, bits a symbol; None for that of this page.
    """
    settle_matplotlib()
    from matplotlib import colormaps  # takes long to import

    bits = information(np.nan_to_num(concentration.astype(np.float64))) / np.log(2)
    shade = np.interp(bits - (bits.mean() if usual is None else usual), AIR_BITS, (0, 1))
    colours = (255 * colormaps["RdYlBu"](shade)[..., :3]).astype(np.uint8)
    size = max(1, _LEAST_MAP_PX // concentration.shape[1])
    return _png(np.kron(colours, np.ones((size, size, 1), np.uint8)))


def _png(picture: NDArray[np.uint8]) -> bytes:
    from PIL import Image  # only where somebody looks

    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(file, "PNG")
    return file.getvalue()
