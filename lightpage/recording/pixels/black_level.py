"""Black level and hot pixels of a camera: taken off, or mended, before anything else reads the counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError

Counts = NDArray[np.unsignedinteger[Any]]

HOT_DEVIATIONS = 8.0
"""A pixel is hot where it is brighter in the dark than the middle one by so many standard deviations of all, estimated
by their quartiles ..."""
HOT_SHARE = 0.01
"""... and by this share of full scale: below it a pixel adds less than shot noise does."""
MOST_HOT = 0.02
"""Share of hot pixels above which a frame was not dark."""

_NEIGHBOURS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]


def without_black(frame: Counts, black_level: int, bit_depth: int) -> Counts:
    """Counts above the black level, of the same type; noise below it becomes 0, full scale stays: it is clipped.

    Args:
        frame: counts [row, column].
        black_level: counts.
        bit_depth: bits of a count.
    """
    if black_level == 0:
        return frame
    black, full_scale = frame.dtype.type(black_level), 2**bit_depth - 1
    return np.where(frame >= full_scale, frame, np.maximum(frame, black) - black).astype(frame.dtype, copy=False)


@dataclass(frozen=True)
class DarkFrame:
    """One camera's counts without light.

    Attributes:
        mean: counts [row, column], rounded mean of some exposures.
        black_level: counts of the middle pixel.
        hot: row and column of the pixels that see light in the dark, [n, 2].
    """

    mean: Counts
    black_level: int
    hot: NDArray[np.intp]

    @classmethod
    def of(cls, frames: NDArray[np.unsignedinteger[Any]], bit_depth: int, subject: str = "dark frames") -> DarkFrame:
        """Return the black level and the hot pixels that exposures without light show.

        Args:
            frames: counts [exposure, row, column].
            bit_depth: bits of a count.
            subject: what they are of, for the error.

        Raises:
            FrameError: so many pixels are bright that there was light.
        """
        mean = frames.mean(axis=0)
        lower, middle, upper = np.percentile(mean, [25, 50, 75])
        full_scale = 2**bit_depth - 1
        excess = max(HOT_DEVIATIONS * float(upper - lower) / 1.349, HOT_SHARE * full_scale)
        hot = np.argwhere(mean > middle + excess)
        black_level = round(float(middle))
        if len(hot) > MOST_HOT * mean.size or black_level > full_scale / 4:
            told = f"a middle count of {middle:.0f} and {len(hot) / mean.size:.1%} brighter pixels"
            raise FrameError(subject, told, "frames without light: is a shutter open?")
        return cls(np.rint(mean).astype(frames.dtype), black_level, hot)


class PixelRepair:
    """Replaces hot pixels by the median of their neighbours that are not.

    Args:
        shape: (rows, columns) of a frame.
        hot: row and column [n, 2].
    """

    def __init__(self, shape: tuple[int, int], hot: NDArray[np.intp]) -> None:
        self.hot = np.asarray(hot, np.intp).reshape(-1, 2)
        bad = np.ones((shape[0] + 2, shape[1] + 2), bool)  # the rim counts as hot: nothing is there
        bad[1:-1, 1:-1] = False
        bad[tuple(self.hot.T + 1)] = True
        around = self.hot[:, None, :] + np.array(_NEIGHBOURS)
        self._usable = ~bad[tuple(np.moveaxis(around + 1, -1, 0))]
        self._around = tuple(np.moveaxis(np.clip(around, 0, np.array(shape) - 1), -1, 0))

    def __call__(self, frame: Counts) -> Counts:
        """The frame with hot pixels replaced, a copy where there are any; one without a good neighbour becomes 0."""
        if not len(self.hot):
            return frame
        values = np.where(self._usable, frame[self._around], np.nan)
        some = self._usable.any(axis=1)
        mended = np.zeros(len(self.hot))
        mended[some] = np.nanmedian(values[some], axis=1)
        copy = frame.copy()
        copy[tuple(self.hot.T)] = np.rint(mended).astype(frame.dtype)
        return copy
