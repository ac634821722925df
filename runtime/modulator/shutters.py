"""Shutters in both beams, each driven by a channel of the pulse generator."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass
from typing import Literal

from lightpage.errors import InvalidInputError, LightpageError
from runtime.errors import LostShotError, Reason
from runtime.trigger.pulse_generator import PulseGenerator

_log = logging.getLogger(__name__)

LONGEST_SETTLE_S = 10.0


@dataclass(frozen=True)
class Shutter:
    """A shutter on a channel.

    Attributes:
        channel: of the pulse generator, 1 is channel A; none that triggers a camera.
        open_when: level at which it is open: ``high`` while the channel is on, ``low`` while it is off.
        settle_s: it has moved after this.

    Raises:
        InvalidInputError: a value is out of range.
    """

    channel: int
    open_when: Literal["high", "low"] = "high"
    settle_s: float = 0.05

    def __post_init__(self) -> None:
        if self.open_when not in ("high", "low"):
            raise InvalidInputError(f"shutter on channel {self.channel}: open_when", self.open_when, "high or low")
        if not (math.isfinite(self.settle_s) and 0 <= self.settle_s <= LONGEST_SETTLE_S):
            subject = f"shutter on channel {self.channel}: settle_s"
            raise InvalidInputError(subject, self.settle_s, f"0 to {LONGEST_SETTLE_S:g} s")


class ShutterBeams:
    """Satisfies `Beams`.

    Args:
        generator: whose channels move the shutters; it may be the cameras' trigger as well.
        signal, reference: the shutters.

    Raises:
        InvalidInputError: both are on one channel.
    """

    def __init__(self, generator: PulseGenerator, signal: Shutter, reference: Shutter) -> None:
        if signal.channel == reference.channel:
            raise InvalidInputError("shutters of signal and reference", f"channel {signal.channel} for both", "two")
        self._generator, self._signal, self._reference = generator, signal, reference
        self.name = f"shutters on channels {signal.channel} and {reference.channel} of {generator.name}"

    def let_through(self, *, signal: bool, reference: bool) -> None:
        """See `Beams`."""
        try:
            for shutter, is_open in ((self._signal, signal), (self._reference, reference)):
                self._generator.set_channel(shutter.channel, is_open == (shutter.open_when == "high"))
        except LostShotError as error:
            raise LostShotError(
                f"{self.name}: {error.subject}", error.got, error.expected, Reason.BEAM_CONTROL_FAILED
            ) from None
        time.sleep(max(self._signal.settle_s, self._reference.settle_s))

    def close(self) -> None:
        """See `Beams`; the pulse generator is let go of as well, and connects again when it is used."""
        try:
            self.let_through(signal=True, reference=True)
        except LightpageError as error:
            _log.warning("beams may still be blocked: %s", error)
        self._generator.close()
