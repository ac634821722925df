"""Runs the window in its own process, so that a slow X server never delays reading."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import SourceError
from lightpage.helper_process import Helper, HelperProcess
from lightpage.runtime.device.modulator.screen.raster import ScreenSettings

if TYPE_CHECKING:
    from lightpage.runtime.device.modulator.screen.x_window import XWindow


def opening_window(settings: ScreenSettings) -> HelperProcess:
    """Start a process that opens a window; its first answer is that of `ScreenWindow.open`.

    Raises:
        WorkerError: it cannot be started.
    """
    # of a table that wires a device, what else it says is not the window's
    plain = ScreenSettings.model_validate(settings.model_dump(include=set(ScreenSettings.model_fields)))
    process = HelperProcess(f"{__name__}:{ScreenWindow.__name__}", subject="window of the modulator")
    process.send("open", plain)
    return process


class ScreenWindow(Helper):
    """A window over a whole monitor."""

    idle_s = 0.1
    """How often it looks at the X server's events without being asked."""

    def __init__(self) -> None:
        self._window: XWindow | None = None

    def open(self, settings: ScreenSettings) -> None:
        """Open the window.

        Raises:
            SourceError: there is no such X server or monitor, or it is not what a modulator needs.
        """
        try:
            from lightpage.runtime.device.modulator.screen.x_window import XWindow
        except (ImportError, OSError) as error:
            expected = "the screen extra (pip install 'lightpage[screen]') and the library libxcb"
            raise SourceError("screen", error, expected) from None
        with _server():
            self._window = XWindow(settings)

    def show(self, image: NDArray[np.uint8]) -> bool:
        """Show a picture [row, column]; returns whether all of it is on display, as far as the X server knows."""
        assert self._window is not None  # it was opened
        with _server():
            self._window.draw(image)
            return self._window.shows

    def shows(self) -> bool:
        """Return whether the whole last picture is still on display."""
        assert self._window is not None  # it was opened
        self.idle()
        with _server():
            return self._window.shows

    def idle(self) -> None:
        """Take note of what the server has said meanwhile."""
        if self._window is not None:
            with _server():
                self._window.look()


@contextmanager
def _server() -> Iterator[None]:
    """End the process where the X server has gone."""
    import xcffib

    try:
        yield
    except xcffib.XcffibException as error:
        sys.exit(f"window of the modulator: {error!r}")
