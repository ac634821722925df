"""Claims about the drift that pages of a recording show."""

import numpy as np
import pytest

from lightpage.runtime.archives.recordings.drift import PageState, described, drift_of, pages_until, steps_of

NAN = float("nan")


def states(pages: int = 400, *, seed: int = 0) -> list[PageState]:
    """Random walks: 0.2 rad of piston, 0.03 px along x and 0.04 px along y a page."""
    walks = np.cumsum(np.random.default_rng(seed).normal(0, (0.2, 0.03, 0.04), (pages, 3)), axis=0)
    return [PageState(float(np.angle(np.exp(1j * p))), x, y, 0.0, 0.0, NAN, 1.0) for p, x, y in walks.tolist()]


def test_steps_are_those_of_the_walk_and_the_piston_is_unwrapped() -> None:
    drift = drift_of(states())
    assert drift["piston_rad"].step == pytest.approx(0.2, rel=0.15)
    assert drift["image_x_px"].step == pytest.approx(0.03, rel=0.15)
    shown = [value for value in drift["piston_rad"].values if value is not None]
    assert np.max(np.abs(np.diff(shown))) < 1
    assert drift["piston_rad"].range == pytest.approx(max(shown) - min(shown))
    assert "stroke_relative" not in drift
    assert described(steps_of(drift)).startswith("piston 0.")


def test_a_walk_of_a_pixel_takes_as_many_pages_as_its_steps_say() -> None:
    assert pages_until(drift_of(states()), 1.0) == pytest.approx(1 / 0.05**2, rel=0.25)
    still = [PageState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)] * 3
    assert pages_until(drift_of(still), 1.0) is None


def test_pages_that_show_nothing_keep_their_place() -> None:
    first, second, third = states(3)
    drift = drift_of([first, PageState(*second[:1], NAN, *second[2:]), third])
    assert drift["image_x_px"].values == (first.image_x_px, None, third.image_x_px)
    assert drift_of([first]) == {}
