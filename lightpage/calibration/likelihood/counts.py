"""Statistics of one camera's counts on the common grid: mean and variance as smooth functions of the expected count.

They include gain, clipping at zero, read noise, quantisation and non-linearity of the camera, and the light that the
fitted device does not explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Self

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field, model_validator

from lightpage.device.profile import Finite, TomlTable
from lightpage.errors import CalibrationError

Real = NDArray[np.float64]

KNOTS = 2048
"""Places of a look-up table: the step from one to the next changes a weight by less than a thousandth."""
_CLASSES = 60
"""Classes of samples with similar expected counts, each with its own mean and variance."""
_MEAN_DEGREE = 7
"""Degree of the mean's Chebyshev series over the root of the expected count."""
_VARIANCE_DEGREE = 5
"""Degree of the same series of the variance's logarithm."""
_FEWEST_CLASSES = 2 * (_MEAN_DEGREE + 1)
"""Fewest classes for the series: twice as many as the longer one has coefficients."""
_POINTS = 33
"""Points that are stored of each function."""
_HEADROOM = 1.3
"""Largest expected count of a look-up table, over the largest that was measured."""
_LEAST_VARIANCE = 1e-6
"""Least variance of a class, over the largest one."""
_LEAST_SLOPE = 1e-3
"""Least slope of the mean. Where counts do not grow with the light, they carry almost no information about it."""
_FEWEST_POINTS = 4
"""Fewest points of a function."""

Values = Annotated[tuple[Finite, ...], Field(strict=False)]


def check_points(expected: Sequence[float], mean: Sequence[float], variance: Sequence[float], camera: str = "") -> None:
    """Check points of the functions of a camera's counts, see `CountStatistics`.

    Args:
        expected, mean, variance: points.
        camera: beginning of the keys' names, such as `in_phase_`.

    Raises:
        ValueError: too few points, lists of different lengths, expected counts that do not increase from 0 or more, or
            a variance that is not above 0.
    """
    name = f"{camera}expected"
    count = len(expected)
    if count < _FEWEST_POINTS:
        raise ValueError(f"{name} of {count} numbers, wanted at least {_FEWEST_POINTS}")
    for key, values in (("mean", mean), ("variance", variance)):
        if len(values) != count:
            raise ValueError(f"{camera}{key} of {len(values)} numbers, wanted {count}, as many as {name} has")
    if expected[0] < 0:
        raise ValueError(f"{name} that begins with {expected[0]:g}, wanted counts of 0 or more")
    for lower, upper in pairwise(expected):
        if not upper > lower:
            raise ValueError(f"{name} with {upper:g} after {lower:g}, wanted counts that increase")
    if not (least := min(variance)) > 0:
        raise ValueError(f"{camera}variance of {least:g}, wanted more than 0")


class CountStatistics(TomlTable):
    """Statistics of one camera's counts, low-passed and resampled to the common grid.

    Attributes:
        expected: counts that the light would give a perfect camera, increasing.
        mean, variance: mean and variance of the measured counts, at each of these.
    """

    expected: Values
    mean: Values
    variance: Values

    @model_validator(mode="after")
    def _checked(self) -> Self:
        check_points(self.expected, self.mean, self.variance)
        return self

    @classmethod
    def measured(cls, expected: Real, counts: Real, subject: str = "counts") -> CountStatistics:
        """Fit smooth functions to samples.

        Args:
            expected: counts that the fitted light would give a perfect camera, [N].
            counts: measured counts, [N].
            subject: name of the counts, for errors.

        Raises:
            CalibrationError: the samples have no variance or too few different expected counts, as in a dark frame.
        """
        if counts.size and np.ptp(counts) == 0:
            raise CalibrationError(
                subject, f"{counts.flat[0]:g} everywhere", "counts of a page, which has light and noise"
            )
        edges = np.quantile(expected, np.linspace(0, 1, _CLASSES + 1)) if expected.size else np.zeros(_CLASSES + 1)
        classes, number = np.unique(np.clip(np.searchsorted(edges, expected) - 1, 0, _CLASSES - 1), return_inverse=True)
        if len(classes) < _FEWEST_CLASSES:
            got = f"samples in {len(classes)} classes of expected counts"
            raise CalibrationError(subject, got, f"at least {_FEWEST_CLASSES}, as the light of a page gives")
        size = np.bincount(number)
        middle = np.bincount(number, expected) / size
        mean = np.bincount(number, counts) / size
        slope = np.gradient(mean, middle)
        residual = counts - mean[number] - slope[number] * (expected - middle[number])
        variance = np.bincount(number, residual**2) / size
        if not variance.max() > 0:
            raise CalibrationError(subject, "no variance about their mean", "counts of a page, which has noise")
        variance = np.maximum(variance, _LEAST_VARIANCE * variance.max())
        root = np.sqrt(middle)
        series = np.polynomial.chebyshev.Chebyshev
        smooth_mean = series.fit(root, mean, _MEAN_DEGREE, w=np.sqrt(size / variance))
        smooth_variance = series.fit(root, np.log(variance), _VARIANCE_DEGREE, w=np.sqrt(size))
        at = np.linspace(root[0], root[-1], _POINTS)
        return cls(
            expected=tuple((at**2).tolist()),
            mean=tuple(smooth_mean(at).tolist()),
            variance=tuple(np.exp(smooth_variance(at)).tolist()),
        )

    @property
    def scale(self) -> float:
        """Index into the look-up tables at an expected count of one; it grows with the root of the count."""
        return float((KNOTS - 1) / np.sqrt(_HEADROOM * self.expected[-1]))

    def weights(self, correlation: float = 1.0) -> NDArray[np.float32]:
        """Compute look-up tables over the root of the expected count.

        Args:
            correlation: variance of a sum of neighbouring samples, over that of independent ones.

        Returns:
            With m the mean of a count, m' its slope, v its variance and c the correlation: m'/(c v), m m'/(c v),
            m'^2/(c v), and m'^2/(c^2 v), [4, KNOTS]. The first two give the score of a count n, m'/(c v) (n - m); the
            third is its Fisher information; the last is the variance of the score.
        """
        counts = (np.arange(KNOTS) / self.scale) ** 2
        expected = np.array(self.expected)
        curve = scipy.interpolate.PchipInterpolator(expected, np.array(self.mean))
        inside = np.clip(counts, expected[0], expected[-1])
        slope = np.maximum(curve.derivative()(inside), _LEAST_SLOPE)
        level = curve(inside) + slope * (counts - inside)
        variance = np.exp(np.interp(inside, expected, np.log(self.variance)))
        weight = slope / (variance * correlation)
        return np.stack([weight, level * weight, slope * weight, weight**2 * variance]).astype(np.float32)
