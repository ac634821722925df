"""Which beams are let through, and a person who sees to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class BeamState(NamedTuple):
    """Of the signal and the reference beam, whether it is let through."""

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
