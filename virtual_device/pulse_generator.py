"""A pulse generator of the BNC 575 and Quantum Composers 9520 family, as seen from its serial line and its outputs."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

IDENTITY = "BNC,575-8,31309,2.4.1-2.0.11"
CHANNELS = 8
T0 = 0
"""Number of the clock among the channels."""


@dataclass(frozen=True)
class _Times:
    """A setting in seconds, or a plain number."""

    least: float
    most: float
    usual: float
    decimals: int = 11

    @property
    def default(self) -> str:
        return f"{self.usual:.{self.decimals}f}"

    def parsed(self, parameter: str) -> str | None:
        try:
            value = float(parameter)
        except ValueError:
            return None
        return f"{value:.{self.decimals}f}" if self.least <= value <= self.most else None


@dataclass(frozen=True)
class _Words:
    """A setting that is one of some keywords, capitals the short form."""

    words: tuple[str, ...]

    @property
    def default(self) -> str:
        return _short(self.words[0])

    def parsed(self, parameter: str) -> str | None:
        return next((_short(word) for word in self.words if _means(parameter, word)), None)


@dataclass(frozen=True)
class _Switch:
    """A setting that is on or off; the answer is 1 or 0."""

    default: str = "0"

    def parsed(self, parameter: str) -> str | None:
        return {"ON": "1", "1": "1", "OFF": "0", "0": "0"}.get(parameter.upper())


_Setting = _Times | _Words | _Switch
_SETTINGS_OF_T0: dict[str, _Setting] = {
    "STATe": _Switch(),
    "MODe": _Words(("NORMal", "SINGle", "BURSt", "DCYCle")),
    "PERiod": _Times(1e-7, 5000.0, 1e-3),
    "BCOunter": _Times(1, 9_999_999, 1, 0),
    "TRIGger:MODe": _Words(("DISabled", "TRIGgered", "DUAL")),
    "TRIGger:EDGe": _Words(("RISing", "FALLing")),
    "TRIGger:LEVel": _Times(0.2, 15.0, 2.5, 2),
}
_SETTINGS_OF_CHANNEL: dict[str, _Setting] = {
    "STATe": _Switch(),
    "WIDTh": _Times(1e-8, 999.99999999975, 1e-3),
    "DELay": _Times(0.0, 999.99999999975, 0.0),
    "CMODe": _Words(("NORMal", "SINGle", "BURSt", "DCYCle")),
    "POLarity": _Words(("NORMal", "COMPlement", "INVerted")),
    "SYNC": _Words(("T0", "CHA", "CHB", "CHC", "CHD", "CHE", "CHF", "CHG", "CHH")),
}
_INSTRUMENT = re.compile(r"PULSE?([0-8])?|(SPULSE?)", re.IGNORECASE)


class PulseGeneratorEmulator:
    """Emulator of a pulse generator: its state and its grammar. Its methods may be called from many threads.

    Not emulated: delays and widths of its pulses in time, and the train of pulses of a running T0 in `NORMal` mode.

    Args:
        cables: functions by channel, each called at every shot while its channel is on.
    """

    def __init__(self, cables: Mapping[int, Callable[[], None]] | None = None) -> None:
        self._cables = dict(cables or {})
        self._lock = threading.RLock()
        """Held during a message; cables are called under it, one after another."""
        self._values: dict[tuple[int, str], str] = {}
        self.shots = 0
        self.messages = 0
        self.power_cycle()

    def power_cycle(self) -> None:
        """Switch it off and on: everything is forgotten."""
        with self._lock:
            self._values = {(T0, name): setting.default for name, setting in _SETTINGS_OF_T0.items()}
            for channel in range(1, CHANNELS + 1):
                self._values |= {(channel, name): setting.default for name, setting in _SETTINGS_OF_CHANNEL.items()}

    def value(self, channel: int, setting: str) -> str:
        """A setting as it is answered, by the manual's name: ``value(1, "WIDTh")``."""
        with self._lock:
            return self._values[channel, setting]

    def answer(self, message: str) -> str:
        """Return the answer to a message; both without line end."""
        with self._lock:
            self.messages += 1
            if message.startswith("*"):
                return self._common(message.upper())
            if not message.startswith(":"):
                return "?1"
            head, _, parameter = message[1:].partition(" ")
            return self._instrument(head, parameter.strip())

    def _common(self, message: str) -> str:
        if message == "*IDN?":
            return IDENTITY
        if message == "*RST":
            self.power_cycle()
            return "ok"
        if message == "*TRG":
            return "ok" if self._edge() else "?8"
        return {"*IDN": "?6", "*TRG?": "?7", "*RST?": "?7", "*": "?2"}.get(message, "?3")

    def _instrument(self, head: str, parameter: str) -> str:
        query = head.endswith("?")
        instrument, _, path = head.removesuffix("?").partition(":")
        found = _INSTRUMENT.fullmatch(instrument)
        if found is None:
            return "?3" if instrument else "?2"
        if not path:
            return "?2"
        channel = T0 if found[2] else int(found[1] or 1)
        settings = _SETTINGS_OF_CHANNEL if channel else _SETTINGS_OF_T0
        name = next((name for name in settings if _means(path, name)), None)
        if name is None:
            return "?3"
        if query:
            return self._values[channel, name]
        if not parameter:
            return "?4"
        value = settings[name].parsed(parameter)
        if value is None:
            return "?5"
        self._set(channel, name, value)
        return "ok"

    def _set(self, channel: int, name: str, value: str) -> None:
        self._values[channel, name] = value
        started = name == "STATe" and channel == T0 and value == "1"
        if started and self._is("MODe", "SING") and self._is("TRIGger:MODe", "DIS"):
            self._shoot()
            self._values[T0, "STATe"] = "0"

    def _edge(self) -> bool:
        """A trigger edge, of which nothing comes unless T0 waits for one; whether it did."""
        waits = self._is("STATe", "1") and not self._is("TRIGger:MODe", "DIS")
        if waits:
            self._shoot()
        return waits

    def _shoot(self) -> None:
        self.shots += 1
        for channel, fire in self._cables.items():
            divides = self._values[channel, "CMODe"] == "DCYC"  # as it is set by default: every other shot
            if self._values[channel, "STATe"] == "1" and not (divides and self.shots % 2):
                fire()

    def _is(self, name: str, value: str) -> bool:
        return self._values[T0, name] == value


def _short(word: str) -> str:
    return "".join(letter for letter in word if not letter.islower())


def _means(given: str, name: str) -> bool:
    """Return whether keywords are given in their long or short forms, in any case."""
    some, names = given.upper().split(":"), name.split(":")
    if len(some) != len(names):
        return False
    return all(one in (_short(word), word.upper()) for one, word in zip(some, names, strict=True))
