"""A modulator that is a monitor, as those with an HDMI input are."""

import os
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from lightpage.clock import SYSTEM, Clock
from lightpage.device.profile import Profile
from lightpage.errors import LostShotError, Reason, SourceError, WorkerError
from lightpage.helper_process import HelperProcess
from lightpage.runtime.device.modulator.screen.raster import Raster, ScreenSettings
from lightpage.runtime.device.modulator.screen.screen_window import opening_window

ANSWER_S = 1.0
"""Longest wait for the window's process to say whether the page is still on display."""


class ScreenModulator:
    """Shows pages in a window over a whole monitor of an X server; the window is in a process of its own.

    A page counts as shown once the X server has put it onto the window, the display has scanned it out once, and the
    liquid crystal has had the time `settle_s`. Where a compositor draws the desktop, it adds a refresh of the display:
    switch it off, or let `settle_s` cover it. The graphics card must leave grey values as they are: no gamma
    correction, no night light, no dithering.

    Args:
        settings: which monitor, its resolution, and where the page lies.
        profile: how large page and symbols are.
        table_of: makes a lookup table, the grey value of each level, for a number of levels.
        window: opens a window, in a process of its own, see `opening_window`.
        clock: clock by which it waits; that of the window.

    Raises:
        InvalidInputError: the page does not lie on the modulator.
    """

    def __init__(
        self,
        settings: ScreenSettings,
        profile: Profile,
        table_of: Callable[[int], NDArray[np.uint8]],
        window: Callable[[ScreenSettings], HelperProcess] = opening_window,
        clock: Clock = SYSTEM,
    ) -> None:
        display = settings.x_display or os.environ.get("DISPLAY", "without DISPLAY")
        self.name = f"screen {display}, monitor {settings.monitor}"
        self._settings, self._make_window, self._clock = settings, window, clock
        self._raster = Raster(profile, settings)
        self._table_of = cache(table_of)
        self._window: HelperProcess | None = None
        self._was_open = False
        self._has_page = False

    def open(self, timeout_s: float, levels: int | None = None) -> None:
        """Open the window unless it is open; see `Modulator`.

        Raises:
            SourceError: no such X server or monitor, or its resolution is not the modulator's.
            InvalidInputError: there is no lookup table for so many levels.
            LostShotError: `Reason.NOT_ON_DISPLAY`: it is not open by then, or it has gone away; opened again next time.
        """
        if levels is not None:
            self._table_of(levels)
        self._opened(self.name, self._clock.now() + timeout_s)

    def show(self, symbols: NDArray[np.uint8], levels: int, page: int, timeout_s: float) -> None:
        """Show a page and return once it is on display; see `Modulator`.

        Raises:
            InvalidInputError: there is no lookup table for so many levels.
            SourceError: see `open`.
            LostShotError: `Reason.NOT_ON_DISPLAY`: not by then, or the window, or the X server, has gone away, or
                something covers the window. It is opened again at the next call.
        """
        deadline = self._clock.now() + timeout_s
        subject = f"page {page} on {self.name}"
        image = self._raster.image(self._table_of(levels)[symbols])
        self._has_page = False
        window = self._opened(subject, deadline)
        try:
            shown = window.ask("show", image, timeout_s=deadline - self._clock.now())
        except WorkerError as error:
            self.close()
            raise _lost(subject, f"nothing on display: {error.got}") from None
        if not shown:
            self.close()
            raise _lost(subject, "a window that something covers, or whose monitor has changed")
        if (settle_s := self._settings.settle_s) > deadline - self._clock.now():
            raise _lost(subject, f"a page that has not settled for {settle_s:g} s after {timeout_s:g} s")
        self._clock.sleep(settle_s)
        self._has_page = True

    def shows(self) -> bool:
        """Return whether the page of the last `show` is still on display, as far as the X server knows."""
        if not self._has_page or self._window is None:
            return False
        try:
            return bool(self._window.ask("shows", timeout_s=ANSWER_S))
        except WorkerError:
            self._has_page = False
            self._window.end()  # and the next `show` finds it so
            return False

    def close(self) -> None:
        """Close the window; `show` opens it again."""
        self._has_page = False
        if self._window is not None:
            self._window.end()
            self._window = None

    def _opened(self, subject: str, deadline: float) -> HelperProcess:
        """The process, its window open."""
        if self._window is not None and self._window.ended():
            self.close()
            raise _lost(subject, "the process of its window, or the X server, has ended")
        try:
            if self._window is None:
                self._window = self._make_window(self._settings)
            if not self._window.poll(deadline - self._clock.now()):
                raise _lost(subject, "a window that is not open yet")
            self._window.answer()
        except (SourceError, WorkerError) as error:
            self.close()
            if self._was_open or isinstance(error, WorkerError):
                raise _lost(subject, error.got) from None
            raise SourceError(self.name, error.got, error.expected) from None
        self._was_open = True
        return self._window


def _lost(subject: str, got: object) -> LostShotError:
    return LostShotError(subject, got, "the page on display", Reason.NOT_ON_DISPLAY)
