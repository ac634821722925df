"""A page as the picture that a modulator shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError, PageError
from lightpage.runtime.device.modulator.settings import RasterSettings


class Raster:
    """Puts a page of grey values onto a modulator's pixels, each symbol a square.

    Args:
        profile: how large page and symbols are.
        settings: the modulator's resolution, and where the page lies.

    Raises:
        InvalidInputError: the page does not lie on the modulator.
    """

    def __init__(self, profile: Profile, settings: RasterSettings) -> None:
        self._page_shape = profile.page_shape
        self._symbol_size_px = profile.page.symbol_size_px
        self._settings = settings
        rows, columns = (count * self._symbol_size_px for count in self._page_shape)
        self._rows = _span("rows", rows, settings.rows_px, settings.offset_y_px)
        self._columns = _span("columns", columns, settings.columns_px, settings.offset_x_px)

    def image(self, greys: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture, uint8 [rows_px, columns_px], of a page of grey values [ny, nx].

        Raises:
            PageError: a page of another shape than the device's.
        """
        if greys.shape != self._page_shape:
            raise PageError("page to show", f"shape {greys.shape}", f"shape {self._page_shape}")
        settings = self._settings
        placed = greys[:: -1 if settings.flip_y else 1, :: -1 if settings.flip_x else 1]
        image = np.full((settings.rows_px, settings.columns_px), settings.background_grey, np.uint8)
        image[self._rows, self._columns] = placed.repeat(self._symbol_size_px, 0).repeat(self._symbol_size_px, 1)
        return image


def _span(what: str, page_px: int, modulator_px: int, offset_px: int) -> slice:
    """Which of the modulator's rows or columns the page takes; what cannot be centred lies half a pixel further up."""
    start = (modulator_px - page_px) // 2 + offset_px
    if start < 0 or start + page_px > modulator_px:
        raise InvalidInputError(
            f"modulator: page of {page_px} {what}",
            f"pixels {start} to {start + page_px - 1} at offset {offset_px}",
            f"pixels from 0 to {modulator_px - 1}",
        )
    return slice(start, start + page_px)
