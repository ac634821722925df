from __future__ import annotations

import numpy as np
import pytest

from lightpage.device.profile import PageLayout, Profile
from lightpage.errors import InvalidInputError, PageError
from runtime.modulator.raster import Raster
from runtime.modulator.settings import RasterSettings
from tests.lightpage.small import small_profile

PAGE = np.array([[10, 20, 30], [40, 50, 60]], np.uint8)


def tiny() -> Profile:
    """A page of 2 x 3 symbols of 2 pixels."""
    return small_profile().model_copy(update={"page": PageLayout(columns=3, rows=2, symbol_size_px=2)})


def image(**settings: object) -> np.ndarray:
    values = {"rows_px": 8, "columns_px": 11, "background_grey": 1, **settings}
    return Raster(tiny(), RasterSettings.model_validate(values)).image(PAGE)


def test_each_symbol_is_a_square_and_the_page_lies_in_the_middle() -> None:
    shown = image()
    assert shown.dtype == np.uint8
    assert shown.shape == (8, 11)
    assert shown[2:6, 2:8].tolist() == [
        [10, 10, 20, 20, 30, 30],
        [10, 10, 20, 20, 30, 30],
        [40, 40, 50, 50, 60, 60],
        [40, 40, 50, 50, 60, 60],
    ]
    shown[2:6, 2:8] = 1
    assert (shown == 1).all()
    with pytest.raises(PageError):
        Raster(tiny(), RasterSettings(rows_px=8, columns_px=10)).image(PAGE.T)


def test_an_offset_moves_the_page_to_the_right_and_down() -> None:
    np.testing.assert_array_equal(image(offset_x_px=3, offset_y_px=-2), np.roll(image(), (-2, 3), (0, 1)))


def test_a_flip_mirrors_the_page_where_it_is() -> None:
    plain = image(columns_px=10)
    np.testing.assert_array_equal(image(columns_px=10, flip_x=True), plain[:, ::-1])
    np.testing.assert_array_equal(image(columns_px=10, flip_y=True), plain[::-1])
    moved = {"columns_px": 10, "offset_x_px": 1}
    np.testing.assert_array_equal(image(flip_x=True, flip_y=True, **moved)[2:6, 3:9], image(**moved)[5:1:-1, 8:2:-1])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"columns_px": 5}, "pixels -1 to"),
        ({"offset_y_px": 3}, "pixels 5 to"),
        ({"offset_x_px": -3}, "pixels -1 to"),
    ],
)
def test_a_page_that_leaves_the_modulator_is_refused(settings: dict[str, int], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        image(**settings)
