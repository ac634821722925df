"""Statistics of a frame's counts over the expected counts: their mean, and the variance of their noise.

Noise is measured at spatial frequencies above those of light through the pipe. So it does not include light that the
fitted waves fail to explain.
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
"""Taps along both axes, of unit power. They pass less than 2% of the amplitude at 0.2 cycles a pixel, the highest
frequency of the pipe's light."""
_CLASSES = 60
"""Classes of samples with similar expected counts."""
_MOST_PIXELS = 2_000_000
"""Approximate limit of the pixels that are measured, evenly chosen in a larger frame."""
_NORMAL = 0.6745
"""Median of the magnitude of normal noise, in standard deviations."""
_OUTLIER = 4.0
"""Standard deviations, estimated by the median, beyond which a pixel is a defect. The noise itself is not estimated by
the median, which underestimates noise of few electrons."""
_DEGREE = 3
"""Degree, along each axis, of the polynomial from pixels to places of the grid; that of registrations."""
_PLACES = 24
"""Approximate number of places along each axis to which it is fitted: fewer than twice as many."""
_BAND = 256
"""Rows of pixels that are resampled at once, so that a large frame takes little memory."""


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
        """Average values in classes of similar expected counts.

        Args:
            expected: expected counts of samples, [n].
            values: the quantity at each sample, [n].
            most: largest value that is averaged, over the median of its class.
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
        """Interpolate the mean at expected counts, with the nearest class outside of them and the darkest for NaN."""
        return np.asarray(np.interp(np.nan_to_num(expected), self.expected, self.means))


def noise_curve(frame: NDArray[np.integer], expected: Image) -> CountCurve:
    """Measure the variance of a frame's noise over the expected count, counts squared.

    Outliers, such as hot pixels and the edges of specks, are excluded.

    Args:
        frame: counts [H, W].
        expected: counts that the light would give a perfect camera, NaN where these are unknown, [H, W].
    """
    noise = _filtered(frame.astype(np.float32), _HIGH_PASS)
    # A sum of pixels has their variances weighted by the squares of the taps, so its expected count is weighted alike.
    level = _filtered(expected, _HIGH_PASS**2)
    known = np.isfinite(level)
    every = -(-noise.size // _MOST_PIXELS)
    return CountCurve.measured(level[known][::every], noise[known][::every] ** 2, (_OUTLIER / _NORMAL) ** 2)


def noise_like(frame: NDArray[np.integer], expected: Image, rng: np.random.Generator) -> Image:
    """Draw normal noise with the variance of a frame's own, counts [H, W], neither rounded nor clipped.

    Args:
        frame: counts [H, W].
        expected: counts that the light would give a perfect camera, NaN where these are unknown, [H, W].
        rng: random generator.
    """
    deviation = np.sqrt(noise_curve(frame, expected).at(expected))
    return np.asarray(deviation * rng.standard_normal(frame.shape, dtype=np.float32), np.float32)


def on_pixels(values: Real, at: Sequence[Real], shape: tuple[int, int]) -> Image:
    """Resample values of the common grid to the pixels of a camera by cubic splines, NaN outside of the grid.

    Args:
        values: values on the common grid, [Gy, Gx].
        at: rows and columns of the pixels at the places of the grid, [2, Gy, Gx].
        shape: shape (H, W) of the camera.
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
        places = [np.polynomial.polynomial.polygrid2d(band, columns, each) for each in inverse]
        values = scipy.ndimage.map_coordinates(spline, places, order=3, prefilter=False, mode="constant", cval=np.nan)
        return np.asarray(values, np.float32)

    bands = [rows[start : start + _BAND] for start in range(0, len(rows), _BAND)]
    return np.concatenate(list(in_parallel(resampled, bands)))


def _filtered(image: Image, taps: Real) -> Image:
    """Convolve along both axes, and crop the pixels at the edges, which lack neighbours."""
    edge = len(taps) // 2
    both = scipy.ndimage.convolve1d(scipy.ndimage.convolve1d(image, taps, axis=0), taps, axis=1)
    return np.asarray(both[edge:-edge, edge:-edge])
