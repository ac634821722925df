"""The phase error that repeats at each symbol is told from that of each page, and judged by other pages."""

import numpy as np
import pytest

from lightpage.calibration.likelihood.flat_field import flat_field

SHAPE = (40, 60)
REPEATED = 0.03
NOISE = 0.02


def errors(pages: int, repeated: float) -> tuple[np.ndarray, np.ndarray]:
    """Pattern that all pages share, and the errors of the pages."""
    rng = np.random.default_rng(pages)
    pattern = rng.normal(0, repeated, SHAPE) if repeated else np.zeros(SHAPE)
    return pattern, pattern + rng.normal(0, NOISE, (pages, *SHAPE))


@pytest.mark.parametrize("pages", [2, 4])
def test_the_mean_is_shrunk_as_the_best_linear_estimate_of_what_repeats(pages: int) -> None:
    pattern, measured = errors(pages, REPEATED)
    found = flat_field(measured, np.full(SHAPE, REPEATED**2 + NOISE**2))
    best = REPEATED**2 / (REPEATED**2 + NOISE**2 / pages)
    np.testing.assert_allclose(found.phases, best * measured.mean(axis=0), rtol=0.05)
    assert np.mean((found.phases - pattern) ** 2) < 1.1 * REPEATED**2 * (1 - best)


def test_a_page_has_no_part_in_what_the_others_say_of_it() -> None:
    _, measured = errors(3, REPEATED)
    changed = measured.copy()
    changed[1] = changed[1][::-1, ::-1]
    variance = np.full(SHAPE, REPEATED**2 + NOISE**2)
    one, other = flat_field(measured, variance), flat_field(changed, variance)
    np.testing.assert_allclose(one.by_others[1] / one.by_others[1].std(), other.by_others[1] / other.by_others[1].std())
    assert np.abs(one.by_others[0] - other.by_others[0]).max() > NOISE


def test_errors_that_do_not_repeat_and_those_of_one_page_make_none() -> None:
    _, measured = errors(2, 0.0)
    assert np.mean(flat_field(measured, np.full(SHAPE, NOISE**2)).phases ** 2) < 0.01 * NOISE**2
    alone = flat_field(errors(1, REPEATED)[1], np.full(SHAPE, REPEATED**2))
    assert not alone.phases.any()
    assert not alone.by_others.any()


def test_symbols_whose_light_misses_the_cameras_hide_nothing_and_get_next_to_nothing() -> None:
    pattern, measured = errors(2, REPEATED)
    variance = np.full(SHAPE, REPEATED**2 + NOISE**2)
    dark = np.s_[:, :6]
    measured[:, *dark] = np.random.default_rng(0).uniform(-np.pi, np.pi, measured[:, *dark].shape)
    variance[dark] = np.pi**2 / 3
    found = flat_field(measured, variance).phases
    assert np.mean((found - pattern)[:, 6:] ** 2) < 0.4 * REPEATED**2
    assert np.abs(found[dark]).max() < 0.2 * REPEATED
