"""Counts of frames over the expected counts, which the fitted waves predict: means, variance of noise, and such noise.

Noise is what varies faster from pixel to pixel than light through the pipe can, so that light that the waves do not
explain is no part of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.waves.parallel import in_parallel

Real = NDArray[np.float64]
Image = NDArray[np.float32]

_HIGH_PASS = np.array((1.0, -4.0, 6.0, -4.0, 1.0)) / np.sqrt(70)
"""Taps along both axes, of unit power. They pass less than 2% of the amplitude of light at 0.2 cycles a pixel, the
highest frequency of the pipe's."""
_CLASSES = 60
"""Classes of samples of like expected counts."""
_MOST_PIXELS = 2_000_000
"""Approximate limit of the pixels that are measured: an even share of a larger frame's."""
_NORMAL = 0.6745
"""Median of the magnitude of normal noise, in standard deviations."""
_OUTLIER = 4.0
"""Standard deviations, as a median has them, beyond which a pixel shows a defect. Noise of few electrons is not normal:
the median alone would call it weaker."""
_DEGREE = 3
"""Degree of the polynomials along each axis by which pixels find their places on the grid, as registrations have it."""
_PLACES = 24
"""Places of the grid along each axis to which these are fitted, at most."""
_BAND = 256
"""Rows of pixels that are resampled at once: a large frame's places all together would take much memory."""


class CountCurve(NamedTuple):
    """Mean of a quantity over the expected count.

    Attributes:
        expected: counts that the light would give a perfect camera, increasing, [N].
        means: mean of the quantity at each of these, [N].
    """

    expected: Real
    means: Real

    @classmethod
    def measured(cls, expected: NDArray[np.floating], values: NDArray[np.floating], most: float = np.inf) -> CountCurve:
        """Average values in classes of like expected counts.

        Args:
            expected: expected counts of samples, [n].
            values: the quantity at each, [n].
            most: values above so many medians of their class are left out.
        """
        if not len(expected):
            return cls(np.zeros(1), np.zeros(1))
        levels: list[float] = []
        means: list[float] = []
        for chosen in np.array_split(np.argsort(expected), min(_CLASSES, len(expected))):
            own = values[chosen]
            usual = own[own <= most * np.median(own)] if np.isfinite(most) else own
            levels.append(float(expected[chosen].mean(dtype=np.float64)))
            means.append(float(usual.mean(dtype=np.float64)))
        return cls(np.array(levels), np.array(means))

    def at(self, expected: NDArray[np.floating]) -> Real:
        """Mean at expected counts; beyond those of the samples that of the nearest, of the darkest where NaN."""
        return np.asarray(np.interp(np.nan_to_num(expected), self.expected, self.means))


def noise_curve(frame: NDArray[np.integer], expected: Image) -> CountCurve:
    """Measure the variance of a frame's noise over the expected count, counts squared.

    Hot pixels and the edges of specks do not count.

    Args:
        frame: counts [H, W].
        expected: counts that the light would give a perfect camera, NaN where that is not known, [H, W].
    """
    noise = _filtered(frame.astype(np.float32), _HIGH_PASS)
    # The squares of the taps weigh the variances of the pixels, and so the counts that these depend on.
    level = _filtered(expected, _HIGH_PASS**2)
    known = np.isfinite(level)
    every = -(-noise.size // _MOST_PIXELS)
    return CountCurve.measured(level[known][::every], noise[known][::every] ** 2, (_OUTLIER / _NORMAL) ** 2)


def noise_like(frame: NDArray[np.integer], expected: Image, rng: np.random.Generator) -> Image:
    """Noise like a frame's own, counts [H, W]; it is neither rounded nor cut off where counts end.

    Args:
        frame: counts [H, W].
        expected: counts that the light would give a perfect camera, NaN where that is not known, [H, W].
        rng: generator that draws it.
    """
    deviation = np.sqrt(noise_curve(frame, expected).at(expected))
    return np.asarray(deviation * rng.standard_normal(frame.shape, dtype=np.float32), np.float32)


def on_pixels(values: Real, at: Sequence[Real], shape: tuple[int, int]) -> Image:
    """Values of the common grid at the pixels of a camera, by cubic splines; NaN where the grid does not reach.

    Args:
        values: [Gy, Gx].
        at: rows and columns of the pixels that see the grid's places, [2, Gy, Gx].
        shape: (H, W) of the camera.
    """
    middle = (np.array(shape) - 1) / 2
    every = tuple(slice(None, None, max(1, size // _PLACES)) for size in values.shape)
    down, across = ((place[every].ravel() - half) / half for place, half in zip(at, middle, strict=True))
    terms = np.polynomial.polynomial.polyvander2d(down, across, [_DEGREE, _DEGREE])
    places = np.indices(values.shape)[:, *every].reshape(2, -1).T
    inverse = np.linalg.lstsq(terms, places, rcond=None)[0].T.reshape(2, _DEGREE + 1, _DEGREE + 1)
    spline = scipy.ndimage.spline_filter(values, order=3, output=np.float32)
    rows, columns = ((np.arange(size) - half) / half for size, half in zip(shape, middle, strict=True))

    def resampled(band: Real) -> Image:
        there = [np.polynomial.polynomial.polygrid2d(band, columns, each) for each in inverse]
        values = scipy.ndimage.map_coordinates(spline, there, order=3, prefilter=False, mode="constant", cval=np.nan)
        return np.asarray(values, np.float32)

    bands = [rows[start : start + _BAND] for start in range(0, len(rows), _BAND)]
    return np.concatenate(list(in_parallel(resampled, bands)))


def _filtered(image: Image, taps: Real) -> Image:
    """Convolution along both axes, without the pixels at the edges, which lack neighbours."""
    edge = len(taps) // 2
    both = scipy.ndimage.convolve1d(scipy.ndimage.convolve1d(image, taps, axis=0), taps, axis=1)
    return np.asarray(both[edge:-edge, edge:-edge])
