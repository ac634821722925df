"""What a modulator's settings are."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from lightpage.device.profile import Side, TomlTable

Offset = Annotated[int, Field(ge=-30_000, le=30_000)]
Grey = Annotated[int, Field(ge=0, le=255)]


class RasterSettings(TomlTable):
    """Where a page lies on the modulator. Pixels are the modulator's; row 0 is its upper edge, column 0 its left one.

    Attributes:
        rows_px, columns_px: the modulator's resolution.
        offset_x_px: how far right of the modulator's centre the page's centre lies.
        offset_y_px: how far below it.
        flip_x: mirror the page, left for right; it stays where it is.
        flip_y: mirror the page, top for bottom; it stays where it is.
        background_grey: grey value beside the page.
    """

    model_config = ConfigDict(strict=True)

    rows_px: Side
    columns_px: Side
    offset_x_px: Offset = 0
    offset_y_px: Offset = 0
    flip_x: bool = False
    flip_y: bool = False
    background_grey: Grey = 0


class ScreenSettings(RasterSettings):
    """A modulator that is a monitor of an X server.

    Attributes:
        x_display: the server, and its screen, as in ``:0`` or ``:0.1``; None for that of the variable DISPLAY.
        monitor: which monitor of that screen, from 0, in the order of ``xrandr --listactivemonitors``.
        settle_s: wait after the display has scanned the page out once, for the liquid crystal, seconds.
    """

    x_display: Annotated[str, Field(min_length=1)] | None = None
    monitor: Annotated[int, Field(ge=0, le=99)] = 0
    settle_s: Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)] = 0.05
