"""Claims about the noise of estimates: it comes back from their errors, and says what they are worth."""

import numpy as np
import pytest

from lightpage.calibration.likelihood.noise import expected_bits, fitted_noise
from lightpage.von_mises import information as nats

COUNT = 20_000


def drawn(factor: float, beside: float) -> tuple[np.ndarray, np.ndarray]:
    """Information of symbols that differ tenfold, and errors of such noise."""
    rng = np.random.default_rng(0)
    information = 200 * 10 ** rng.uniform(-0.5, 0.5, COUNT)
    return information, rng.vonmises(0, 1 / (factor / information + beside))


@pytest.mark.parametrize("factor", [1.4, 100.0])
def test_noise_that_the_information_explains_is_a_factor_on_it(factor: float) -> None:
    information, errors = drawn(factor, 0.0)
    noise = fitted_noise(errors, information)
    assert noise[0] == pytest.approx(factor, rel=0.05)
    assert noise[1] < 0.05 * factor / 200


def test_noise_beside_it_is_told_from_it() -> None:
    information, errors = drawn(0.2, 0.03)
    noise = fitted_noise(errors, information)
    assert noise[1] == pytest.approx(0.03, rel=0.05)
    assert noise[0] == pytest.approx(0.2, abs=0.2)
    both, errors = drawn(4.0, 0.02)
    np.testing.assert_allclose(fitted_noise(errors, both), (4.0, 0.02), rtol=0.1)


def test_symbols_without_information_have_uniform_errors_and_are_worth_nothing() -> None:
    information, _ = drawn(1.0, 0.0)
    errors = np.random.default_rng(1).uniform(-np.pi, np.pi, COUNT)
    assert expected_bits(fitted_noise(errors, information), information) < 0.01


def test_expected_bits_are_those_of_von_mises_densities() -> None:
    information, _ = drawn(1.0, 0.0)
    noise = np.array([2.0, 0.01], np.float32)
    expected = np.mean(nats(1 / (noise[0] / information + noise[1]))) / np.log(2)
    assert expected_bits(noise, information) == pytest.approx(expected, rel=1e-6)
    better = expected_bits(np.array([1.0, 0.01], np.float32), information)
    assert better > expected_bits(noise, information)


def test_errors_of_zero_have_the_least_noise() -> None:
    noise = fitted_noise(np.zeros(COUNT), np.full(COUNT, 200.0))
    assert np.isfinite(noise).all()
    assert expected_bits(noise, np.full(COUNT, 200.0)) > 15
