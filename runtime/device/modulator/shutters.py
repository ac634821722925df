"""Shutters in both beams, each driven by a channel of the pulse generator."""

import logging
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from lightpage.clock import SYSTEM, Clock
from lightpage.device.profile import StrictTable
from lightpage.errors import LightpageError, LostShotError, Reason, SourceError
from lightpage.runtime.device.trigger.pulse_generator import Channel, PulseGenerator

_log = logging.getLogger(__name__)


class Shutter(StrictTable):
    """A shutter on a channel of the pulse generator."""

    channel: Channel
    """Channel of the shutter, none of the cameras'. 1 is A."""
    open_when: Literal["high", "low"] = "high"
    """The shutter is open while the channel is on (`high`) or off (`low`)."""
    settle_s: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.05
    """Time that the shutter takes to move."""

    def level(self, is_open: bool) -> bool:
        """Return whether its channel is on while it is open, or closed."""
        return is_open == (self.open_when == "high")


class ShutterBeams:
    """Satisfies `Beams`.

    Args:
        generator: generator whose channels move the shutters; it may be the cameras' trigger as well.
        signal, reference: the shutters.
        clock: clock by which they settle.
    """

    def __init__(self, generator: PulseGenerator, signal: Shutter, reference: Shutter, clock: Clock = SYSTEM) -> None:
        self._generator, self._signal, self._reference, self._clock = generator, signal, reference, clock
        self._moved = False
        self.name = f"shutters on channels {signal.channel} and {reference.channel} of {generator.name}"

    def let_through(self, *, signal: bool, reference: bool) -> None:
        """See `Beams`. Where it fails, both shutters are opened when the generator is next set up."""
        wanted = (self._signal, signal), (self._reference, reference)
        try:
            try:
                self._move(wanted)
            except LostShotError as error:
                if error.reason is not Reason.TRIGGER_GONE:
                    raise
                self._move(wanted)  # which puts the line in order first
        except BaseException as error:
            for shutter in (self._signal, self._reference):
                self._generator.remember_channel(shutter.channel, shutter.level(is_open=True))
            self._moved = self._moved or self._generator.reached
            if isinstance(error, LostShotError):
                raise LostShotError(
                    f"{self.name}: {error.subject}", error.got, error.expected, Reason.BEAM_CONTROL_FAILED
                ) from None
            raise
        self._clock.sleep(max(self._signal.settle_s, self._reference.settle_s))

    def _move(self, wanted: Sequence[tuple[Shutter, bool]]) -> None:
        """Move the shutters, one after another. One that cannot be opened does not keep the other one closed."""
        failed: LightpageError | None = None
        for shutter, is_open in wanted:
            try:
                self._generator.set_channel(shutter.channel, shutter.level(is_open))
                self._moved = True
            except (LostShotError, SourceError) as error:
                if not is_open or (isinstance(error, LostShotError) and error.reason is Reason.TRIGGER_GONE):
                    raise
                failed = failed or error
        if failed is not None:
            raise failed

    def close(self) -> None:
        """See `Beams`; the pulse generator is let go of as well, and connects again when it is used."""
        if self._moved:  # else nothing blocks them, and perhaps there is nothing to be connected to
            try:
                self.let_through(signal=True, reference=True)
            except LightpageError as error:
                _log.warning("beams may still be blocked: %s", error)
        self._generator.close()
