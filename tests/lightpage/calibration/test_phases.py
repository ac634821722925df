"""The phase of the signal against the reference, and what a shift over a reference that stays adds to it."""

from __future__ import annotations

import numpy as np
import pytest

from lightpage.calibration.phases import camera_phase, tilt_of_shift

NAMES = ("tilt_x", "tilt_y", "curvature", "astigmatism_0", "astigmatism_45")
HALF_WIDTH, HALF_HEIGHT = 1.6e-3, 1.0e-3
CORNER = float(np.hypot(HALF_WIDTH, HALF_HEIGHT))


def phase(value: dict[str, float], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """At points in metres."""
    return np.asarray(camera_phase(value, x / CORNER, y / CORNER, HALF_WIDTH / CORNER, HALF_HEIGHT / CORNER))


@pytest.mark.parametrize("seed", range(3))
def test_a_shift_over_a_curved_reference_is_a_tilt_and_a_piston(seed: int) -> None:
    rng = np.random.default_rng(seed)
    value = {f"camera_{name}_rad": float(rng.normal()) for name in NAMES}
    shift = rng.uniform(-3e-5, 3e-5, 2)
    x, y = rng.uniform(-1, 1, (2, 50)) * [[HALF_WIDTH], [HALF_HEIGHT]]
    gained = phase(value, x + shift[0], y + shift[1]) - phase(value, x, y)
    tilt = tilt_of_shift(value, shift, HALF_WIDTH, HALF_HEIGHT)
    left = gained - tilt[0] * x / HALF_WIDTH - tilt[1] * y / HALF_HEIGHT
    np.testing.assert_allclose(left, left[0], atol=1e-12)
