"""The settings of a modulator that is a monitor, and a page as the picture that it shows."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lightpage.device.profile import Profile, Side, StrictTable
from lightpage.errors import InvalidInputError

Offset = Annotated[int, Field(ge=-30_000, le=30_000)]


class ScreenSettings(StrictTable):
    """A modulator that is a monitor of an X server, and where a page lies on it.

    Pixels are the modulator's; row 0 is its upper edge, column 0 its left one.
    """

    rows_px: Side
    """The modulator's rows. The monitor's mode must have as many."""
    columns_px: Side
    """The modulator's columns."""
    offset_x_px: Offset = 0
    """Distance of the page's middle to the right of the modulator's."""
    offset_y_px: Offset = 0
    """Distance of the page's middle below the modulator's."""
    flip_x: bool = False
    """Mirror the page, left for right. It stays where it is."""
    flip_y: bool = False
    """Mirror the page, top for bottom. It stays where it is."""
    background_grey: Annotated[int, Field(ge=0, le=255)] = 0
    """Grey value beside the page."""
    x_display: Annotated[str, Field(min_length=1)] | None = None
    """X display and screen, e.g. `:0`. Without it the variable DISPLAY counts."""
    monitor: Annotated[int, Field(ge=0, le=99)] = 0
    """Number of the monitor, from 0, as `xrandr --listactivemonitors` has it."""
    settle_s: Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)] = 0.05
    """Wait for the liquid crystal, after the page was scanned out once."""


class Raster:
    """Puts a page of grey values onto a modulator's pixels, each symbol a square.

    Args:
        profile: how large page and symbols are.
        settings: the modulator's resolution, and where the page lies.

    Raises:
        InvalidInputError: the page does not lie on the modulator.
    """

    def __init__(self, profile: Profile, settings: ScreenSettings) -> None:
        self._symbol_size_px = profile.page.symbol_size_px
        self._settings = settings
        rows, columns = (count * self._symbol_size_px for count in profile.page_shape)
        self._rows = _span("rows", rows, settings.rows_px, settings.offset_y_px)
        self._columns = _span("columns", columns, settings.columns_px, settings.offset_x_px)

    def image(self, greys: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture, uint8 [rows_px, columns_px], of a page of grey values [ny, nx]."""
        settings = self._settings
        placed = greys[:: -1 if settings.flip_y else 1, :: -1 if settings.flip_x else 1]
        image = np.full((settings.rows_px, settings.columns_px), settings.background_grey, np.uint8)
        image[self._rows, self._columns] = placed.repeat(self._symbol_size_px, 0).repeat(self._symbol_size_px, 1)
        return image


def _span(what: str, page_px: int, modulator_px: int, offset_px: int) -> slice:
    """Return the modulator's rows or columns that the page takes; an odd rest puts it half a pixel further up."""
    start = (modulator_px - page_px) // 2 + offset_px
    if start < 0 or start + page_px > modulator_px:
        got = f"pixels {start} to {start + page_px - 1} at offset {offset_px}"
        raise InvalidInputError(f"modulator: page of {page_px} {what}", got, f"pixels from 0 to {modulator_px - 1}")
    return slice(start, start + page_px)
