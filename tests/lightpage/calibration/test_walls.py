"""The difference of a pipe's height and width by the light of one known page."""

import pytest

from lightpage.calibration.goodness.light import PageLight
from lightpage.calibration.goodness.walls import WallDifference, wall_difference
from tests.lightpage.calibration.test_goodness import TWIN, fitted_page


@pytest.mark.long
@pytest.mark.parametrize("difference", [0.0, -0.002])
def test_the_difference_is_right_within_its_deviations(difference: float) -> None:
    known, conditions, pair, symbols = fitted_page(f"geometry.pipe_height_relative_error={difference}")
    measured = wall_difference(PageLight(TWIN, known, conditions, pair, symbols))
    assert measured is not None
    assert measured.relative == pytest.approx(difference, abs=max(5 * measured.deviation, 0.1 * abs(difference)))
    assert measured.deviation < 2e-4


def test_it_is_stated_in_micrometres() -> None:
    assert str(WallDifference(-0.001, 2e-5, 0.89e-3)) == " (height minus width: -0.890 +- 0.018 um)"
