"""Claims about the statistics of counts: what is measured of a camera, and what the tables make of it."""

import numpy as np
import pytest
import scipy
from pydantic import ValidationError

from lightpage.calibration.likelihood.counts import KNOTS, CountStatistics
from lightpage.errors import CalibrationError

GAIN, ELECTRONS, READ = 0.9, 8.0, 1.5
"""Counts for one that is expected, electrons of a count, and read noise in counts."""
BINS = 10


def seen(seed: int, count: int = 400_000) -> tuple[np.ndarray, np.ndarray]:
    """Expected counts of bright and dark places, and those that a noisy camera gives, which clip at zero."""
    rng = np.random.default_rng(seed)
    expected = rng.uniform(0, 14, count) ** 2
    light = rng.poisson(GAIN * ELECTRONS * expected) / ELECTRONS
    return expected, np.maximum(light + READ * rng.standard_normal(count), 0)


@pytest.fixture(scope="module")
def statistics() -> CountStatistics:
    return CountStatistics.measured(*seen(1))


def scores(weights: np.ndarray, scale: float, expected: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, ...]:
    """Derivatives of the log-likelihood by the expected counts, and the tables' values there, [4, N]."""
    places = np.minimum(np.rint(scale * np.sqrt(expected)).astype(int), KNOTS - 1)
    found = weights[:, places].astype(np.float64)
    return counts * found[0] - found[1], found


def by_bin(expected: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means over samples of like expected counts."""
    order = np.argsort(expected)
    return np.array([part.mean() for part in np.array_split(values[order], BINS)])


def test_mean_and_variance_of_a_noisy_camera_come_back(statistics: CountStatistics) -> None:
    light = GAIN * np.array(statistics.expected)
    deviation = np.sqrt(light / ELECTRONS + READ**2)
    below = scipy.stats.norm(0, 1)
    clipped = light * below.cdf(light / deviation) + deviation * below.pdf(light / deviation)
    square = (light**2 + deviation**2) * below.cdf(light / deviation) + light * deviation * below.pdf(light / deviation)
    assert clipped[0] > light[0] + 0.3  # clipping shows where there is next to no light
    np.testing.assert_allclose(statistics.mean, clipped, atol=0.08)
    np.testing.assert_allclose(statistics.variance, square - clipped**2, rtol=0.15)


def test_scores_of_other_pages_are_zero_on_average_at_every_brightness(statistics: CountStatistics) -> None:
    expected, counts = seen(2)
    score, tables = scores(statistics.weights(), statistics.scale, expected, counts)
    assert np.abs(by_bin(expected, score / np.sqrt(tables[3]))).max() < 0.03
    dimmer, _ = scores(statistics.weights(), statistics.scale, 0.9 * expected, counts)
    assert by_bin(expected, dimmer)[1:].min() > 0  # more light would explain them better


def test_the_information_is_that_of_the_scores_and_chi_square_is_one(statistics: CountStatistics) -> None:
    expected, counts = seen(3)
    score, tables = scores(statistics.weights(), statistics.scale, expected, counts)
    np.testing.assert_allclose(by_bin(expected, score**2 / tables[3]), 1, atol=0.08)
    np.testing.assert_allclose(by_bin(expected, score**2), by_bin(expected, tables[2]), rtol=0.08)


def test_correlated_samples_tell_less_and_fit_as_well(statistics: CountStatistics) -> None:
    alone, together = statistics.weights(), statistics.weights(4.0)
    np.testing.assert_allclose(together[:3], alone[:3] / 4, rtol=1e-6)
    expected, counts = seen(3)
    score, tables = scores(together, statistics.scale, expected, counts)
    assert np.mean(score**2 / tables[3]) == pytest.approx(1, abs=0.03)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("expected", "counts", "got"),
    [
        (np.linspace(1, 100, 1000), np.zeros(1000), "0 everywhere"),
        (np.linspace(1, 100, 1000), np.full(1000, 255.0), "255 everywhere"),
        (np.full(1000, 7.0), np.arange(1000.0), "samples in 1 classes"),
        (np.repeat([1.0, 2.0, 3.0], 500), np.arange(1500.0), "samples in 3 classes"),
        (np.zeros(0), np.zeros(0), "samples in 0 classes"),
    ],
)
def test_a_dark_or_constant_frame_has_no_statistics(expected: np.ndarray, counts: np.ndarray, got: str) -> None:
    with pytest.raises(CalibrationError, match=f"^in-phase: got {got}"):
        CountStatistics.measured(expected, counts, "in-phase")


@pytest.mark.filterwarnings("error")
def test_a_share_of_equal_expected_counts_does_no_harm(statistics: CountStatistics) -> None:
    """A margin without light is one value of the expected count, and fills several quantiles."""
    expected, counts = seen(2)
    dark = np.arange(len(expected)) < len(expected) // 5
    other = CountStatistics.measured(np.where(dark, 0.25, expected), np.where(dark, 0.1, counts))
    bright = np.array(statistics.expected) > 20
    mean = np.interp(np.array(statistics.expected)[bright], other.expected, other.mean)
    np.testing.assert_allclose(mean, np.array(statistics.mean)[bright], rtol=0.02)


RIGHT = {"expected": (0.0, 1.0, 2.0, 3.0), "mean": (0.0, 1.0, 2.0, 3.0), "variance": (1.0,) * 4}


@pytest.mark.parametrize(
    ("key", "values", "problem"),
    [
        ("expected", (0.0, 1.0, 1.0, 3.0), "expected with 1 after 1"),
        ("expected", (3.0, 2.0, 1.0, 0.0), "expected with 2 after 3"),
        ("expected", (-1.0, 1.0, 2.0, 3.0), "expected that begins with -1"),
        ("expected", (0.0, 1.0, 2.0), "expected of 3 numbers"),
        ("expected", (0.0, 1.0, 2.0, float("nan")), "finite"),
        ("mean", (0.0, 1.0, 2.0), "mean of 3 numbers"),
        ("variance", (1.0,) * 5, "variance of 5 numbers"),
        ("variance", (1.0, 0.0, 1.0, 1.0), "variance of 0"),
        ("variance", (1.0, -2.0, 1.0, 1.0), "variance of -2"),
        ("variance", (1.0, float("inf"), 1.0, 1.0), "finite"),
    ],
)
def test_points_that_are_no_function_are_refused(key: str, values: tuple[float, ...], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        CountStatistics.model_validate({**RIGHT, key: values})
