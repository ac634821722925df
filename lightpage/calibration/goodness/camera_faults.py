"""Faults of the cameras and of their exposures that the counts of a known page show, beside the light that they share.

With a reference of R counts, interference u R and signal v R, an ideal camera counts R (1 + u + v). Counts of others
differ by a factor on v, by a constant times R, or by a term of second order. All of these are fitted where a pixel is
bright enough not to be clipped.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.calibration.goodness.frame_noise import noise_curve
from lightpage.calibration.goodness.light import PageLight
from lightpage.calibration.goodness.remedies import BEND, BLACK_LEVEL, REFERENCE_EXPOSURE, VIBRATION
from lightpage.words import counted

Real = NDArray[np.float64]
Image = NDArray[np.float32]

_BRIGHT = 0.7
"""Least expected count of a pixel that is fitted, over the reference's."""
_FEWEST = 100
"""Least number of pixels that terms are fitted to."""
_CORRELATED = 3.0
"""Variance of the fitted terms over that of as many independent equations."""
_DEVIATIONS = 5.0
"""Standard deviations from which on a term is a fault."""
_LEAST_CONSTANT = 0.03
_LEAST_CONTRAST = 0.08
_LEAST_BEND = 0.04
"""Least terms that are named. The resampling of frames makes up to 0.02 of a signal's factor."""
_EXCHANGED = 0.02
"""Largest deviation from 1 of the product of exchanged references' exposures."""
_BLACK_SHARE = 0.25
"""Share of a black level, by the factor on v, that the noise of dark pixels must show."""
_SPECK_PX = 2.0
"""Standard deviation of the filter with which shadows are searched, pixels."""
_LEAST_SHADE = 0.1
"""Least share of the light that a shadow takes."""
_SHADE_DEVIATIONS = 7.0
"""Standard deviations from which on a place is a shadow."""
_REACH_PX = 6
"""Distance from a shaded place to which its shadow is measured, pixels."""
_SMOOTHINGS_PX = (0.5, 1.0, 1.5, _SPECK_PX)
"""Standard deviations of filters with which a shadow may be measured; the first whose noise is low enough is taken."""
_MOST_NOISE = 0.03
"""Largest noise of a measured shadow, over the light."""
_EDGE_SHADE = 0.03
"""Share of the light that a shadow takes at its edge."""
_LEAST_PASSED = 0.26
"""Least share of the light that passes: gains are bytes, and one is stored as 64."""
_JOINED_PX = 2
"""Half of the distance to which shaded pixels belong to one shadow."""
_NAMED = 3
"""Places that are named of each camera."""
_MOST_SHADE = 0.1
"""Largest share of pixels in shadows; more are no dust."""


class CountTerms(NamedTuple):
    """Terms of one camera's counts beyond those of an ideal camera.

    Attributes:
        constant: excess of the counts, relative to the reference's, where there is neither interference nor signal.
        contrast: relative excess of the signal's power over the square of its interference.
        bend: term of second order, over the reference's counts at the brightest ones.
        deviations: standard deviations of these three, [3].
        black: black level by the noise of pixels, over the reference's mean counts.
    """

    constant: float
    contrast: float
    bend: float
    deviations: Real
    black: float

    def exceeds(self, number: int, least: float) -> bool:
        """Return whether one of the first three terms is a fault."""
        term = (self.constant, self.contrast, self.bend)[number]
        return abs(term) > max(least, _DEVIATIONS * float(self.deviations[number]))


def count_terms(light: PageLight) -> list[CountTerms]:
    """Fit the terms of both cameras' counts, before the mean counts are corrected."""
    terms = []
    frames = (light.pair.in_phase, light.pair.quadrature)
    for camera, (frame, expected) in enumerate(zip(frames, light.expected_frames(), strict=True)):
        bright = light.visible & (light.brightness[camera] > _BRIGHT)
        if np.count_nonzero(bright) < _FEWEST:
            terms.append(CountTerms(0.0, 0.0, 0.0, np.full(3, np.inf), 0.0))
            continue
        interference, power = (part[camera][bright] for part in light.interference_and_power())
        brightness = 1 + interference + power
        level = light.references[camera][bright]
        top = float(np.max(level * brightness))
        columns = [np.ones_like(power), interference + 2 * power, power, brightness * (brightness - 1) * level / top]
        weight = 1 / np.sqrt(brightness)
        matrix = np.stack(columns, axis=1) / 2 * weight[:, None]
        right = light.count_residual[camera][bright] * weight
        solution = np.linalg.lstsq(matrix, right, rcond=None)[0]
        variance = _CORRELATED * np.mean((right - matrix @ solution) ** 2)
        deviations = np.sqrt(variance * np.diag(np.linalg.pinv(matrix.T @ matrix)))
        constant, _, contrast, bend = map(float, solution)
        black = _black_level(frame, expected) / float(np.mean(level))
        terms.append(CountTerms(constant, contrast, bend, deviations[[0, 2, 3]], black))
    return terms


def _black_level(frame: NDArray[np.integer], expected: Image) -> float:
    """Black level at which the variance of noise, in proportion to the light, would vanish, counts."""
    curve = noise_curve(frame, expected)
    dark = curve.expected < 0.8 * curve.expected.max()
    if np.count_nonzero(dark) < 3:
        return 0.0
    slope, constant = np.polyfit(curve.expected[dark], curve.means[dark], 1, w=1 / np.maximum(curve.means[dark], 0.1))
    return float(max(0.0, -(constant - 1 / 12) / slope)) if slope > 0 else 0.0


def named_contrast(terms: list[CountTerms]) -> str:
    """Name the cause of a wrong ratio of interference and signal; empty where the terms show none."""
    if all(each.exceeds(0, _LEAST_CONSTANT) for each in terms):
        return REFERENCE_EXPOSURE
    strong = [each for each in terms if each.contrast > 0 and each.exceeds(1, _LEAST_CONTRAST)]
    if not strong:
        return BEND if any(each.exceeds(2, _LEAST_BEND) for each in terms) else ""
    level = np.mean([each.contrast / (1 + each.contrast) for each in strong])
    black = np.mean([each.black for each in strong])
    return BLACK_LEVEL if black > _BLACK_SHARE * level or len(strong) < len(terms) else VIBRATION


def named_exposures(terms: list[CountTerms]) -> str:
    """Exposure of both references over that of the pages, in words.

    Where one is too long by as much as the other is too short, they may be exchanged.
    """
    in_phase, quadrature = (1 / (1 + each.constant) for each in terms)
    exchanged = (in_phase - 1) * (quadrature - 1) < 0 and abs(in_phase * quadrature - 1) < _EXCHANGED
    words = f"in-phase {in_phase:.3f}, quadrature {quadrature:.3f} times the pages'"
    return f" ({words}{': as exchanged references would show' if exchanged else ''})"


def contrast_bits(terms: list[CountTerms]) -> float:
    """Information that a loss of the fringes' contrast costs, bits a symbol."""
    excess = float(np.mean([max(0.0, each.contrast) for each in terms]))
    return float(np.log2(1 + excess)) / 2


def passed_light(frames: list[NDArray[np.integer]], expected: list[Image]) -> Image:
    """Share of the light that passes dust before the pixels of one camera, 1 where there is none, [H, W].

    Args:
        frames: counts of pages, [H, W] each.
        expected: counts that the light would give a perfect camera, NaN where these are unknown, [H, W] each.
    """
    known: NDArray[np.bool_] = np.all([np.isfinite(each) for each in expected], axis=0)
    products = np.zeros(known.shape)
    squares = np.zeros(known.shape)
    for frame, light in zip(frames, expected, strict=True):
        clean = np.where(known, light, 0)
        products += frame * clean
        squares += clean**2
    ratio = _smooth_ratio(products, squares, _SPECK_PX)
    smooth = scipy.ndimage.gaussian_filter(squares, _SPECK_PX)
    bright = known & (smooth > 0.1 * np.median(smooth[known])) if known.any() else known
    if not bright.any():
        return np.ones(known.shape, np.float32)
    usual, spread = _usual(ratio[bright])
    dark = bright & (ratio < usual - max(_LEAST_SHADE, _SHADE_DEVIATIONS * spread))
    near = bright & (scipy.ndimage.distance_transform_edt(~dark) <= _REACH_PX)
    if not (dark.any() and np.mean(dark) < _MOST_SHADE and (bright & ~near).any()):
        return np.ones(known.shape, np.float32)
    for smoothing in _SMOOTHINGS_PX:
        ratio = _smooth_ratio(products, squares, smoothing)
        usual, spread = _usual(ratio[bright & ~near])
        if spread <= _MOST_NOISE:
            break
    shaded = near & (ratio < usual - _EDGE_SHADE)
    return np.where(shaded, np.maximum(ratio / usual, _LEAST_PASSED), 1).astype(np.float32)


def _smooth_ratio(products: Real, squares: Real, smoothing_px: float) -> Real:
    """Ratio of two smoothed images, 1 where the second is dark."""
    above = scipy.ndimage.gaussian_filter(products, smoothing_px)
    below = scipy.ndimage.gaussian_filter(squares, smoothing_px)
    return np.where(below > 0, above / np.where(below > 0, below, 1), 1)


def _usual(values: Real) -> tuple[float, float]:
    """Median of values, and their standard deviation, to which outliers do not count."""
    return float(np.median(values)), float(scipy.stats.median_abs_deviation(values, scale="normal"))


def named_shadows(dark: NDArray[np.bool_]) -> str:
    """Name the places of shadows on both cameras, [2, H, W], in words; empty where there are none."""
    parts = []
    for name, shaded in zip(("in-phase", "quadrature"), dark, strict=True):
        labels, count = scipy.ndimage.label(scipy.ndimage.binary_dilation(shaded, iterations=_JOINED_PX))
        middles = scipy.ndimage.center_of_mass(shaded, labels, range(1, min(count, _NAMED) + 1))
        places = ", ".join(f"({round(column)}, {round(row)})" for row, column in middles)
        if count:
            parts.append(f"{name} camera: {counted(count, 'speck')} at {places}{', ...' if count > _NAMED else ''}")
    return f" ({'; '.join(parts)})" if parts else ""
