"""What shows a page, and what blocks the beams."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Modulator(Protocol):
    """A light modulator. One thread at a time uses it."""

    name: str
    """For people, e.g. ``screen :0.1``."""

    def open(self, timeout_s: float, levels: int | None = None) -> None:
        """Connect, unless that is done: with this, wrong settings show before the first page.

        Args:
            timeout_s: longest wait.
            levels: M of the pages that are to be shown, where it is known.

        Raises:
            SourceError: it is not there, or not as it was said to be.
            InvalidInputError: it cannot show so many levels.
            LostShotError: `Reason.NOT_ON_DISPLAY`: it is not ready by then.
        """

    def show(self, symbols: NDArray[np.uint8], levels: int, page: int, timeout_s: float) -> None:
        """Show a page and return once it is on display.

        Args:
            symbols: [ny, nx].
            levels: M.
            page: its number in the source, for a controller that shows it by itself.
            timeout_s: longest wait.

        Raises:
            LostShotError: `Reason.NOT_ON_DISPLAY`: it is not on display by then, or the modulator has gone away.
        """

    def shows(self) -> bool:
        """Whether the page of the last `show` is still on display."""

    def close(self) -> None:
        """Let go of it; `show` connects again."""


class Beams(Protocol):
    """Lets the beams through, or blocks them. One thread at a time uses it."""

    name: str
    """For people, e.g. ``shutters on channels C and D``."""

    def let_through(self, *, signal: bool, reference: bool) -> None:
        """Open and close both; returns once they have moved. After `close` both are open.

        Raises:
            LostShotError: `Reason.BEAM_CONTROL_FAILED`.
            SourceError: this device cannot.
        """

    def close(self) -> None:
        """Let go of it, both beams let through."""
