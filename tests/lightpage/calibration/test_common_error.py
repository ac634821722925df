"""The smooth error that pages share, from their pilots alone."""

import numpy as np
import pytest

from lightpage.calibration.common_error import common_error
from lightpage.page.modulation import NOMINAL, Modulation

SHAPE = 40, 60
NOISE_RAD = 0.02


def smooth() -> np.ndarray:
    """An error that grows towards the page's edges, as a pipe at another angle makes it."""
    y, x = np.meshgrid(np.linspace(-1, 1, SHAPE[0]), np.linspace(-1, 1, SHAPE[1]), indexing="ij")
    return np.asarray(0.1 * x * y - 0.15 * x**2 * y + 0.05 * y**3)


def pages(count: int, modulation: Modulation = NOMINAL, pilots: int = 54) -> tuple[np.ndarray, ...]:
    """Phases as decoded, claims, where the pilots are, what was written there, and the other symbols' error."""
    rng = np.random.default_rng(count)
    mask = np.zeros(SHAPE, bool)
    mask.ravel()[rng.choice(mask.size, pilots, replace=False)] = True
    written = rng.uniform(0, 2 * np.pi, (count, *SHAPE))
    written[:, mask] = written[0][mask]
    off = smooth() + rng.normal(0, NOISE_RAD, written.shape) + np.linspace(-0.1, 0.1, count)[:, None, None]
    off[rng.random(written.shape) < 0.02] += 1.0  # a dead place of the modulator
    phases = modulation.phase(np.mod(written, 2 * np.pi)) + off
    return phases, np.full(phases.shape, NOISE_RAD**-2), mask, written[0][mask], written


@pytest.mark.parametrize(("count", "most_rad"), [(6, 0.012), (1, 0.025)])
def test_pilots_free_all_symbols_of_what_they_share(count: int, most_rad: float) -> None:
    phases, claimed, mask, pilots, written = pages(count)
    found = common_error(phases, claimed, mask, pilots, NOMINAL)
    left = phases - np.mod(written, 2 * np.pi) - found.phase - found.pistons[:, None, None]
    assert np.abs(np.median(left, axis=(1, 2))).max() < 0.01
    assert (smooth() - found.phase).std() < most_rad
    assert found.modulation is NOMINAL


def test_a_stroke_that_has_changed_is_told_from_a_smooth_error() -> None:
    changed = Modulation((-0.02, *NOMINAL.coefficients[1:]))
    phases, claimed, mask, pilots, _ = pages(6, changed)
    found = common_error(phases, claimed, mask, pilots, NOMINAL)
    assert found.modulation.coefficients[0] == pytest.approx(-0.02, abs=0.004)
    again = common_error(phases, claimed, mask, pilots, changed)
    assert again.modulation is changed


def test_pages_without_an_error_stay_as_they_are() -> None:
    phases, claimed, mask, pilots, _ = pages(3)
    found = common_error(phases - smooth(), claimed, mask, pilots, NOMINAL)
    assert found.phase.std() < 0.005
    assert found.scale == pytest.approx(1, abs=0.2)
    np.testing.assert_allclose(found.pistons, [-0.1, 0, 0.1], atol=0.01)
