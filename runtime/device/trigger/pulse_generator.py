"""A pulse generator of the BNC 575 and Quantum Composers 9520 family, as the trigger of both cameras.

`:PULSE0` is its clock T0, `:PULSE1` to `:PULSE8` are its channels A to H.
"""

import logging
import re
import threading
from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import Field, field_validator

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import LostShotError, Reason, SourceError
from lightpage.runtime.device.trigger.scpi_line import ScpiLine
from lightpage.runtime.device.trigger.scpi_port import LineTimes

_log = logging.getLogger(__name__)

CHANNELS = 8
RESOLUTION_S = 1e-8
"""Coarsest step of width and delay in the family, and its shortest pulse: what is read back may differ by as much."""

_NUMBER = re.compile(r"[+-]?\d+(\.\d*)?([eE][+-]?\d+)?")
_WORD = re.compile(r"[A-Z][A-Z0-9]*", re.IGNORECASE)
_STATE = re.compile(r"[01]|ON|OFF", re.IGNORECASE)
_ON = {"1", "ON"}
_POLARITIES = {"normal": "NORM", "inverted": "INV"}
_TRIGGER_MODES = {"single": "DIS", "software": "TRIG"}

Channel = Annotated[int, Field(ge=1, le=CHANNELS)]


class PulseGeneratorSettings(LineTimes):
    """Address and settings of the pulse generator."""

    port: Annotated[str, Field(min_length=1)]
    """Device of the serial line, e.g. `/dev/serial/by-id/...`, or `socket://HOST:PORT`."""
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115200
    """Bits per second of a serial line."""
    channels: Annotated[tuple[Channel, ...], Field(min_length=1, strict=False)] = (1, 2)
    """Channels that trigger the cameras. 1 is A."""
    width_s: Annotated[float, Field(ge=RESOLUTION_S, le=10.0)] = 1e-3
    """Width of their pulses."""
    delay_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    """Delay of their pulses after T0."""
    polarity: Literal["normal", "inverted"] = "normal"
    """Polarity of their pulses. `inverted` rests high."""
    fire: Literal["single", "software"] = "single"
    """`single` starts T0 in single-shot mode. `software` sends `*TRG`, which stands for an edge."""
    reset: bool = False
    """Send `*RST` before anything is set."""

    @field_validator("channels")
    @classmethod
    def _each_once(cls, channels: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(channels)) != len(channels):
            raise ValueError("a channel twice, wanted each once")
        return channels


class PulseGenerator:
    """Satisfies `Trigger`; its other channels are outputs that are switched on and off. Many threads may use it.

    Nothing is fired unless the line has worked without interruption since the device was set up: it may have been
    switched off and on meanwhile, or be another one.

    Args:
        settings: see there.
        clock: clock by which it waits, and tells the time of a shot.
    """

    def __init__(self, settings: PulseGeneratorSettings, clock: Clock = SYSTEM) -> None:
        self.settings = settings
        self._line = ScpiLine(settings.port, settings.baud, settings, clock)
        self.name = self._line.name
        self._lock = threading.RLock()
        """Held during each of the methods: a shot does not come between the steps of a set-up."""
        self._ready: int | None = None
        """Session of the line in which the device was set up."""
        self._switched: dict[int, bool] = {}
        """Other channels, as the next `arm` switches them."""

    @property
    def reached(self) -> bool:
        """Return whether it has ever answered: before, nothing but a question for its identity was sent."""
        return self._line.session > 0

    def arm(self) -> None:
        """See `Trigger`. Other channels are switched again as they were: the device may have forgotten.

        Raises:
            SourceError: no such line, no device that answers on it, or it does not take a setting.
            LostShotError: `Reason.TRIGGER_GONE`: it was there before, and does not answer any more.
        """
        with self._lock:
            self._ready = None
            reached = self.reached
            try:
                self._ready = self._set_up()
            except LostShotError as error:
                if reached and error.reason is not Reason.TRIGGER_REFUSED:
                    raise
                raise SourceError(error.subject, error.got, error.expected) from None

    def fire(self) -> float:
        """See `Trigger`; returns the middle of the sending of the command that fires."""
        with self._lock:
            if self._ready is None:
                raise LostShotError(self.name, "a shot before it was set up", "arm first", Reason.TRIGGER_GONE)
            try:
                fired = self._line.send(":PULSE0:STATE ON", self._ready)
                return self._line.send("*TRG", self._ready) if self.settings.fire == "software" else fired
            except LostShotError as error:
                if error.reason is not Reason.TRIGGER_REFUSED:
                    self._ready = None
                raise

    def disarm(self) -> None:
        """See `Trigger`: stops T0, and switches off the cameras' channels. A device that has gone fires no more anyway.

        Channels that stayed on would fire for the next user, and hide that the next user's channels differ.
        """
        with self._lock:
            ready, self._ready = self._ready, None
            if ready is None:
                return
            try:
                for channel in (0, *self.settings.channels):
                    self._line.send(f":PULSE{channel}:STATE OFF", ready)
            except LostShotError as error:
                _log.warning("not disarmed: %s", error)

    def close(self) -> None:
        """See `Trigger`."""
        with self._lock:
            self.disarm()
            self._line.close()

    def set_channel(self, channel: int, on: bool) -> None:
        """Switch the output of a channel that triggers no camera, and read back that it is so; connects if needed.

        The channel is inverted: it rests high while it is on, apart from the shortest pulse there is at every shot, and
        low while it is off. The device need not be armed.

        Raises:
            LostShotError: `Reason.TRIGGER_GONE`, `Reason.TRIGGER_REFUSED`.
            SourceError: the device says `ok` and does something else.
        """
        with self._lock:
            self._line.send(f":PULSE{channel}:POL INV")
            self._switch(channel, on, self._line.session)
            self._switched[channel] = on

    def remember_channel(self, channel: int, on: bool) -> None:
        """Have the next `arm` switch a channel so; nothing is sent now."""
        with self._lock:
            self._switched[channel] = on

    def _switch(self, channel: int, on: bool, session: int) -> None:
        prefix = f":PULSE{channel}"
        self._set_word(f"{prefix}:POL", "INV", session)
        self._set_time(f"{prefix}:WIDT", RESOLUTION_S, session)
        self._set_state(f"{prefix}:STATE", on, session)

    def _set_up(self) -> int:
        """Set everything and read it back; returns the session in which that was."""
        settings = self.settings
        self._line.send(":PULSE0:STATE OFF")
        session = self._line.session
        if settings.reset:
            self._line.send("*RST", session)
        self._set_word(":PULSE0:MODE", "SING", session)
        self._set_word(":PULSE0:TRIG:MODE", _TRIGGER_MODES[settings.fire], session)
        for channel in settings.channels:
            prefix = f":PULSE{channel}"
            self._set_word(f"{prefix}:POL", _POLARITIES[settings.polarity], session)
            self._pulse_at_each_shot(prefix, session)
            self._set_time(f"{prefix}:WIDT", settings.width_s, session)
            self._set_time(f"{prefix}:DELAY", settings.delay_s, session)
            self._set_state(f"{prefix}:STATE", True, session)
        for channel, on in self._switched.items():
            self._switch(channel, on, session)
        return session

    def _pulse_at_each_shot(self, prefix: str, session: int) -> None:
        """Take back a divider or a burst of a channel; a device that knows neither refuses, and has none."""
        try:
            self._set_word(f"{prefix}:CMOD", "NORM", session)
        except LostShotError as error:
            if error.reason is not Reason.TRIGGER_REFUSED:
                raise

    def _set_word(self, setting: str, value: str, session: int) -> None:
        """Set a keyword, of which the device may answer the long form or the short one."""
        self._set(setting, value, _WORD, lambda found: found.upper().startswith(value), session)

    def _set_time(self, setting: str, value: float, session: int) -> None:
        self._set(setting, f"{value:.11f}", _NUMBER, lambda found: abs(float(found) - value) <= RESOLUTION_S, session)

    def _set_state(self, setting: str, on: bool, session: int) -> None:
        self._set(setting, "ON" if on else "OFF", _STATE, lambda found: (found.upper() in _ON) == on, session)

    def _set(self, setting: str, value: str, form: re.Pattern[str], holds: Callable[[str], bool], session: int) -> None:
        self._line.send(f"{setting} {value}", session)
        found = self._line.query(f"{setting}?", form, session)
        if not holds(found):
            raise SourceError(f"{self.name}: {setting}", f"{found} after {value} was set", value)
