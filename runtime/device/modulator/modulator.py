"""The interfaces of the modulator, which shows pages, and of the beam control: a device, or a person."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

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
        """Return whether the page of the last `show` is still on display."""

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


class BeamState(NamedTuple):
    """State of the signal and the reference beam: let through or blocked."""

    signal: bool
    reference: bool

    def __str__(self) -> str:
        words = {True: "let through", False: "blocked"}
        return f"signal beam {words[self.signal]}, reference beam {words[self.reference]}"


BOTH = BeamState(signal=True, reference=True)


class OperatorBeams:
    """Asks a person to block the beams and to let them through, for a device without shutters.

    Args:
        ask: shows a person a sentence and returns once they have done what it says. What it raises where there is
            nobody to ask goes through to the caller.
    """

    name = "beams that a person blocks"

    def __init__(self, ask: Callable[[str], None]) -> None:
        self._ask = ask
        self._state = BOTH

    def let_through(self, *, signal: bool, reference: bool) -> None:
        """Ask for each beam that is not as it is wanted; see `Beams`."""
        wanted = BeamState(signal, reference)
        if tasks := [
            f"{'let' if through else 'block'} the {beam} beam{' through' if through else ''}"
            for beam, through, before in zip(wanted._fields, wanted, self._state, strict=True)
            if through != before
        ]:
            sentence = " and ".join(tasks)
            self._ask(sentence[0].upper() + sentence[1:])
        self._state = wanted

    def close(self) -> None:
        """Ask for the beams that are still blocked; see `Beams`."""
        self.let_through(signal=True, reference=True)
