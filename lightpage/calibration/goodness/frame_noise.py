"""Noise of a frame as the frame shows it: what varies faster from pixel to pixel than light through the pipe can."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

_HIGH_PASS = (1.0, -4.0, 6.0, -4.0, 1.0)
"""Along both axes it passes less than 2% of the amplitude of what the pipe's light shows, at 0.2 cycles a pixel."""
_SMOOTHED_PX = 3
"""Side of the squares of pixels whose mean stands for a pixel's expected count."""
_CLASSES = 20
"""Number of classes of pixels of like counts, each with a variance of its own."""
_ROUNDING = 1 / 12
"""Variance that counts have as whole numbers."""
_NORMAL = 0.6745
"""Median of the magnitude of normal noise, in standard deviations."""


def noise_variance(frame: NDArray[np.integer]) -> tuple[float, float]:
    """Variance of a pixel's noise, counts squared: the part that does not grow with its count, and that by count.

    Medians stand for variances, so that hot pixels and specks do not count.

    Args:
        frame: counts [H, W].
    """
    counts = frame.astype(np.float32)
    taps = np.array(_HIGH_PASS) / np.linalg.norm(_HIGH_PASS)
    edge = len(taps) // 2
    inside = (slice(edge, -edge), slice(edge, -edge))
    noise = scipy.ndimage.convolve1d(scipy.ndimage.convolve1d(counts, taps, axis=0), taps, axis=1)[inside]
    expected = scipy.ndimage.uniform_filter(counts, 2 * _SMOOTHED_PX + 1)[inside]
    order = np.argsort(expected, axis=None)
    level, variance = (np.empty(_CLASSES) for _ in range(2))
    for number, chosen in enumerate(np.array_split(order, _CLASSES)):
        level[number] = expected.ravel()[chosen].mean()
        variance[number] = (np.median(np.abs(noise.ravel()[chosen])) / _NORMAL) ** 2
    # Clipped or flat classes say nothing; errors of a variance grow with it.
    told = variance > 0
    weight = 1 / np.maximum(variance[told], _ROUNDING)
    terms = np.stack([np.ones(_CLASSES), level], axis=1)[told]
    (fixed, by_count), _ = scipy.optimize.nnls(terms * weight[:, None], variance[told] * weight)
    return float(fixed), float(by_count)


def with_more_noise(frame: NDArray[np.integer], times: float, rng: np.random.Generator) -> NDArray[np.integer]:
    """A frame of the same type with so many times its noise added.

    Args:
        frame: counts [H, W].
        times: standard deviation of what is added over that of the frame's own noise.
        rng: draws it.
    """
    fixed, by_count = noise_variance(frame)
    expected = scipy.ndimage.uniform_filter(frame.astype(np.float32), _SMOOTHED_PX)
    deviation = times * np.sqrt(np.clip(fixed + by_count * expected, 0, None))
    seen = np.rint(frame + deviation * rng.standard_normal(frame.shape, dtype=np.float32))
    return np.asarray(np.clip(seen, 0, np.iinfo(frame.dtype).max), dtype=frame.dtype)
