"""Which beams are let through."""

from __future__ import annotations

from typing import NamedTuple


class BeamState(NamedTuple):
    """Of the signal and the reference beam, whether it is let through."""

    signal: bool
    reference: bool

    def __str__(self) -> str:
        words = {True: "let through", False: "blocked"}
        return f"signal beam {words[self.signal]}, reference beam {words[self.reference]}"


BOTH = BeamState(signal=True, reference=True)
