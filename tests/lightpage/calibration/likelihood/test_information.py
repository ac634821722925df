"""Information of symbols is smooth over the page, but for symbols whose light lies beside a camera."""

import numpy as np
import pytest

from lightpage.calibration.likelihood.information import _DAMPING, _smoothed

SHAPE = (56, 87)
SPREAD = 0.15
SEEN = np.ones(SHAPE)


def measured(seed: int = 0) -> np.ndarray:
    return np.asarray(np.random.default_rng(seed).normal(1, SPREAD, SHAPE))


@pytest.mark.parametrize("axis", [0, 1])
def test_symbols_beside_a_camera_do_not_lower_the_information_of_others_nor_take_theirs(axis: int) -> None:
    information = measured()
    corner = np.moveaxis(information, axis, 0)
    corner[-1, -9:] = 0.05
    smoothed = np.moveaxis(_smoothed(information, SEEN), axis, 0)
    np.testing.assert_allclose(smoothed[-1, -9:], 0.05 * _DAMPING)
    np.testing.assert_allclose(smoothed[-2, -8:], 1, atol=0.3)
    assert np.mean(smoothed[-2, -8:]) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("spread", [SPREAD, 0.5])
def test_what_varies_with_the_page_is_smoothed(spread: float) -> None:
    information = np.random.default_rng(0).normal(1, spread, SHAPE)
    assert np.std(_smoothed(information, SEEN)) < spread / 3


@pytest.mark.parametrize("own", [0.2, -0.1])
def test_rays_tell_symbols_beside_a_camera_where_the_page_varies_more(own: float) -> None:
    information, seen = np.random.default_rng(0).normal(1, 0.3, SHAPE), np.ones(SHAPE)
    information[:9, -1] = own
    seen[:9, -1] = 0.45
    smoothed = _smoothed(information, seen)
    assert np.all(smoothed[:9, -1] <= 1.1 * _DAMPING * max(own, 0.06))
    assert np.all(smoothed[:9, -1] > 0)
    assert np.mean(smoothed[:8, -2]) == pytest.approx(1, abs=0.15)
