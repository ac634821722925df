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
_MOST_PIXELS = 2_000_000
"""Pixels that are looked at, about: an even share of a larger frame's."""
_ROUNDING = 1 / 12
"""Variance that counts have as whole numbers."""
_NORMAL = 0.6745
"""Median of the magnitude of normal noise, in standard deviations."""
_OUTLIER = 4.0
"""Standard deviations, as a median has them, beyond which a pixel shows a defect. Noise of few electrons is not normal:
the median alone would call it weaker."""


def noise_variance(frame: NDArray[np.integer]) -> tuple[float, float]:
    """Variance of a pixel's noise, counts squared: the part that does not grow with its count, and that by count.

    Hot pixels and specks do not count.

    Args:
        frame: counts [H, W].
    """
    counts = frame.astype(np.float32)
    taps = np.array(_HIGH_PASS) / np.linalg.norm(_HIGH_PASS)
    edge = len(taps) // 2
    inside = (slice(edge, -edge), slice(edge, -edge))
    # the squares of the taps weigh the pixels' variances, and so the counts that these go with
    noise, expected = (
        scipy.ndimage.convolve1d(scipy.ndimage.convolve1d(counts, weights, axis=0), weights, axis=1)[inside]
        for weights in (taps, taps**2)
    )
    every = -(-noise.size // _MOST_PIXELS)
    noise, expected = (values.ravel()[::every] for values in (noise, expected))
    order = np.argsort(expected)
    level, variance = (np.empty(_CLASSES) for _ in range(2))
    for number, chosen in enumerate(np.array_split(order, _CLASSES)):
        level[number] = expected[chosen].mean()
        power = noise[chosen] ** 2
        variance[number] = power[power <= _OUTLIER**2 * np.median(power) / _NORMAL**2].mean()
    # Clipped or flat classes say nothing; errors of a variance grow with it.
    told = variance > 0
    weight = 1 / np.maximum(variance[told], _ROUNDING)
    terms = np.stack([np.ones(_CLASSES), level], axis=1)[told]
    (fixed, by_count), _ = scipy.optimize.nnls(terms * weight[:, None], variance[told] * weight)
    return float(fixed), float(by_count)


def noise_like(frame: NDArray[np.integer], rng: np.random.Generator) -> NDArray[np.float32]:
    """Noise like a frame's own, counts [H, W]; it is neither rounded nor cut off where counts end.

    Args:
        frame: counts [H, W].
        rng: draws it.
    """
    fixed, by_count = noise_variance(frame)
    expected = scipy.ndimage.uniform_filter(frame.astype(np.float32), _SMOOTHED_PX)
    deviation = np.sqrt(np.clip(fixed + by_count * expected, 0, None))
    return np.asarray(deviation * rng.standard_normal(frame.shape, dtype=np.float32), np.float32)
