"""The frames of a golden page, stored in few counts: they prove what a runtime computes, not how well a page reads."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.recording.frame_pair import FramePair

_SIDE_PX = 2
"""Side of the blocks of pixels that get one count: a sample of the usual grid, which still has all fringes."""
_COUNTS = 32
"""Counts that are left of a camera's. At 15,000 electrons a step is about four times a bright pixel's own noise."""


def shows_page(coarse: float, residual: float, limit: float) -> bool:
    """Whether frames in few counts may stand for a page: how badly they fit the homodyne equations tells.

    Args:
        coarse: residual of the frames `in_few_counts`.
        residual: of the page's own frames.
        limit: largest residual of a pair that the bundle decodes.

    Returns:
        Whether `coarse` is no nearer to the limit than half way, in ratio: the image is also looked for off its place.
    """
    return bool(coarse <= np.sqrt(residual * limit))


def in_few_counts(pair: FramePair, bit_depth: int) -> FramePair:
    """Means of blocks of 2 x 2 pixels, each one of 32 counts: compressed, they take about a sixth of the room.

    Args:
        pair: counts [H, W].
        bit_depth: bits of a count, 8 to 16.

    Returns:
        Frames of the same shapes and types, none of them black or at full scale.
    """
    step = (1 << bit_depth) // _COUNTS
    return FramePair(_coarse(pair.in_phase, step), _coarse(pair.quadrature, step))


def _coarse(frame: NDArray[np.integer[Any]], step: int) -> NDArray[np.integer[Any]]:
    rows, columns = frame.shape
    whole = np.pad(frame, ((0, -rows % _SIDE_PX), (0, -columns % _SIDE_PX)), mode="edge")
    blocks = whole.reshape(whole.shape[0] // _SIDE_PX, _SIDE_PX, whole.shape[1] // _SIDE_PX, _SIDE_PX)
    means = blocks.sum(axis=(1, 3), dtype=np.uint32) // _SIDE_PX**2
    rounded = np.asarray(means // step * step + step // 2, dtype=frame.dtype)
    return np.ascontiguousarray(rounded.repeat(_SIDE_PX, 0).repeat(_SIDE_PX, 1)[:rows, :columns])
