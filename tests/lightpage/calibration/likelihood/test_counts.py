"""Claims about the statistics of counts: what is measured of a camera, and what the tables make of it."""

import numpy as np
import pytest
import scipy

from lightpage.calibration.likelihood.counts import KNOTS, CountStatistics

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
