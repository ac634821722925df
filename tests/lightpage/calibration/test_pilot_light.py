"""Evidence of the pilots' light for a geometry."""

import numpy as np

from lightpage.calibration.unknown_pages.pilot_light import told_nats, told_slope

RNG = np.random.default_rng(3)
EXPECTED = RNG.uniform(0, 1, (3, 54))


def noise(*shape: int) -> np.ndarray:
    return RNG.standard_normal(shape) + 1j * RNG.standard_normal(shape)


def test_unrelated_light_tells_one_nat_and_that_of_pilots_much_more_whatever_its_phase() -> None:
    unrelated = told_nats(noise(4000, 3, 54), EXPECTED)
    np.testing.assert_allclose([unrelated.mean(), unrelated.std()], 1, atol=0.1)
    light = EXPECTED * np.exp(2j) + noise(10, 3, 54)
    assert told_nats(light, EXPECTED).min() > 10
    np.testing.assert_allclose(told_nats(1j * light, EXPECTED), told_nats(light, EXPECTED))


def test_its_slope_is_the_derivative() -> None:
    light, change = EXPECTED + noise(2, 3, 54), noise(2, 3, 54)
    there, back = (told_nats(light + side * 1e-5 * change, EXPECTED) for side in (1, -1))
    by_slope = np.real(np.sum(told_slope(light, EXPECTED) * change, axis=(-2, -1)))
    np.testing.assert_allclose(by_slope, (there - back) / 2e-5, rtol=1e-4)
