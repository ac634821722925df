"""A serial port with an SCPI device behind it: one message, one answer, and never the answer of another message.

An SCPI device numbers neither messages nor answers, but answers in order: once a `*IDN?` has been answered, nothing can
come of a message from before. After anything unexpected the port is therefore synchronised before the next message:
wait for silence, send `*IDN?`, and want exactly one identification for every `*IDN?` sent so far, then silence again;
and all of it twice. Identifications that are still due are counted, so that a late one is not taken for a newer one.

A line ends with CR, with LF or with both: devices and serial servers differ. NULs between lines are noise.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from lightpage.clock import SYSTEM, Clock
from lightpage.device.profile import StrictTable
from lightpage.errors import LostShotError, Reason, SourceError

if TYPE_CHECKING:
    from serial import Serial

try:
    from termios import error as _TerminalError
except ModuleNotFoundError:  # as on Windows
    _TerminalError = OSError  # type: ignore[misc,assignment]

GONE = (OSError, _TerminalError, TypeError)
"""What pyserial raises of a port that was unplugged: its own SerialException is an OSError, `termios.error` is none,
and TypeError comes of a descriptor that is gone."""
REFUSALS = {
    1: "incorrect prefix",
    2: "missing keyword",
    3: "invalid keyword",
    4: "missing parameter",
    5: "invalid parameter",
    6: "this can only be queried",
    7: "this cannot be queried",
    8: "not possible in the present state",
}
"""Answers `?1` to `?8` of the BNC 575 and Quantum Composers 9520 family."""

_IDENTIFY = "*IDN?"
_IDENTIFICATION = re.compile(r"[!-~][ -~]*,[ -~]+,[ -~]+")
"""Maker, model, serial number, and mostly versions."""
_REFUSED = re.compile(r"\?([1-8])")
_POLL_S = 0.02
"""Longest wait inside pyserial."""
_LONGEST_LINE = 512
_END = re.compile(rb"[\r\n]")
_NO_LINE = b"\r\n"
"""What is no line by itself: the rest of an end."""
_QUOTED = 80
"""Most characters of what came that an error quotes."""
_ROUNDS = 2
"""Identifications in a row, each with silence after, that make a port synchronised."""


class LineTimes(StrictTable):
    """Waiting times on a line."""

    answer_s: Annotated[float, Field(ge=0.02, le=10.0)] = 0.5
    """Longest wait for an answer."""
    quiet_s: Annotated[float, Field(ge=0.005, le=1.0)] = 0.05
    """Silence that shows that no answer is on its way."""
    late_s: Annotated[float, Field(ge=0.02, le=10.0)] = 1.0
    """Longest wait for a late identification, while another has come already."""
    synchronise_s: Annotated[float, Field(ge=0.2, le=60.0)] = 4.0
    """Longest wait until a disturbed line is in order."""

    @property
    def longest_s(self) -> float:
        """Bound of one query: pyserial connects within 5 s, the line may have to be synchronised twice."""
        return 6.0 + 2 * self.synchronise_s + 3 * self.answer_s


class ScpiPort:
    """Used by one thread only; `lightpage.runtime.device.trigger.scpi_line` has the thread.

    Args:
        port: device path or pyserial URL.
        baud: speed of a tty.
        times: how long is waited.
        clock: clock by which it is waited.

    Attributes:
        session: grows whenever the port is synchronised. As long as it stays, every message was answered.
        identity: what the device says of itself, once that is known.
    """

    def __init__(self, port: str, baud: int, times: LineTimes, clock: Clock = SYSTEM) -> None:
        self.name = f"pulse generator {port}"
        self.session = 0
        self.identity: str | None = None
        self._path, self._baud, self._times = port, baud, times
        self._now = clock.now
        self._port: Serial | None = None
        self._adapter: tuple[object, ...] | None = None
        """The USB adapter behind the port, where it is one: plugged in again, it may have another path."""
        self._buffer = bytearray()
        self._heard = ""
        """What came last and was no answer, while the port is synchronised."""
        self._slowest_s = 0.0
        """How long the identification took, at most, while the port is synchronised."""
        self._asked: list[float] = []
        """When identifications were asked for, while the port is synchronised."""
        self._synchronised = self._echo = False
        self._known = False
        """Whether `identity` has come often enough, since the port was opened, to be relied on."""
        self._due = 0
        """Identifications that were asked for and have not come."""
        self._given_up = 0
        """Those of them that are taken as lost."""

    def ask(self, message: str, answer: re.Pattern[str], session: int | None, deadline: float) -> tuple[str, float]:
        """Send a message and return its answer, and the middle of its sending by the clock.

        Args:
            message: without line end.
            answer: what an answer looks like, all of it.
            session: send it in this session only; None connects and synchronises first where that is needed.
            deadline: it is not sent after this time by the clock.

        Raises:
            LostShotError: `Reason.TRIGGER_GONE`: no such answer, or no port; `Reason.TRIGGER_REFUSED`: answered `?n`.
            SourceError: the port's name or the baud rate makes no sense.
        """
        port = self._ready(session)
        if self._now() > deadline:
            raise self._gone(f"no time left to send {message}", "an answer in time")
        try:
            begin, end = self._send(port, message)
            found = self._answer(port, message, answer)
            return found, (begin + min(end, self._now())) / 2  # it was sent when the answer came
        except GONE as error:
            self.close()
            raise self._gone(f"{_words(error)} at {message}", "a device that is plugged in") from None

    def ask_twice(self, message: str, answer: re.Pattern[str], session: int | None, deadline: float) -> str:
        """Send a query twice and return the answer if both are the same: a digit that a line alters shows.

        Raises:
            LostShotError, SourceError: see `ask`.
        """
        first, _ = self.ask(message, answer, session, deadline)
        second, _ = self.ask(message, answer, self.session, deadline)
        if first != second:
            self._synchronised = False
            raise self._gone(f"{first!r}, then {second!r} as answers to {message}", "the same answer twice")
        return first

    def close(self) -> None:
        """Let go of the port; the next message opens it again."""
        port, self._port = self._port, None
        self._synchronised = False
        self._buffer.clear()
        self._given_up, self._due = self._given_up + self._due, 0
        if port is not None:
            with suppress(*GONE):
                port.close()

    def _ready(self, session: int | None) -> Serial:
        """The open port, synchronised."""
        port = self._port
        if port is not None and self._synchronised:
            try:
                reads = iter(range(_LONGEST_LINE))  # of a socket a byte each
                while port.in_waiting and not self._buffer.strip(_NO_LINE) and next(reads, None) is not None:
                    self._read(port)
                self._synchronised = not self._buffer.strip(_NO_LINE)  # nothing was asked: whose answer is that?
            except GONE:
                self.close()
        if port is not None and self._synchronised and session in (None, self.session):
            return port
        if session is not None:
            raise self._gone("a line that was interrupted since the device was set up", "a device that is set up")
        if self._port is not None:
            try:
                self._synchronise(self._port)
                return self._port
            except GONE:
                self.close()  # unplugged since; it may be back by now
        port = self._open()
        try:
            self._synchronise(port)
        except GONE as error:
            self.close()
            raise self._gone(_words(error), "a device that is plugged in") from None
        return port

    def _open(self) -> Serial:
        import serial  # takes a while, and most have no such device

        alone = None if "://" in self._path else True
        adapters = {} if alone is None else _usb_adapters()
        path = next((path for path, adapter in adapters.items() if adapter == self._adapter), self._path)
        try:
            self._port = serial.serial_for_url(
                path, baudrate=self._baud, timeout=_POLL_S, write_timeout=self._times.answer_s, exclusive=alone
            )
        except ValueError as error:
            raise SourceError(self.name, error, "a serial port or a pyserial URL, and a baud rate") from None
        except GONE as error:
            raise self._gone(_words(error), "a serial port that can be opened") from None
        self._known = False
        self._adapter = self._adapter or adapters.get(os.path.realpath(path))
        return self._port

    def _send(self, port: Serial, message: str) -> tuple[float, float]:
        """Send a line; returns begin and end of its sending, as far as that can be known."""
        line = message.encode("ascii") + b"\r\n"
        begin = self._now()
        port.write(line)
        end = self._now()
        if "://" not in self._path:
            end = max(end, begin + 10 * len(line) / self._baud)  # write() only fills the driver's buffer
        return begin, end

    def _answer(self, port: Serial, message: str, answer: re.Pattern[str]) -> str:
        until = self._now() + self._times.answer_s
        line = self._line(port, until)
        if line == message:  # the port echoes
            self._echo = True
            line = self._line(port, until)
        elif self._echo and line is not None:
            self._synchronised = False
            self._identified(line)
            raise self._gone(f"{_quoted(line)} before the echo of {message}", "the echo first")
        if line is not None and (refused := _REFUSED.fullmatch(line)):
            meaning = REFUSALS[int(refused[1])]
            raise LostShotError(self.name, f"{line} ({meaning}) to {message}", "no refusal", Reason.TRIGGER_REFUSED)
        if line is not None and answer.fullmatch(line):
            return line
        self._synchronised = False
        if line is None:
            told = f"no answer to {message} within answer_s = {self._times.answer_s:g} s"
            if self._buffer:
                raise self._gone(f"{told}, but {_quoted(bytes(self._buffer))} without an end", "a line with CR or LF")
            raise self._gone(told, "an answer")
        self._identified(line)
        raise self._gone(f"{_quoted(line)} to {message}", f"an answer like {answer.pattern}")

    def _synchronise(self, port: Serial) -> None:
        """Make sure that nothing is on its way any more; see the module.

        Raises:
            LostShotError: that cannot be had in time; the port is closed.
        """
        self._synchronised = False
        self._heard, self._slowest_s, self._asked = "", 0.0, []
        end = self._now() + self._times.synchronise_s
        rounds = 0
        while rounds < _ROUNDS:
            if self._now() > end:
                self.close()
                raise self._unclear()
            if not self._quiet(port, end):
                continue
            self._asked.append(self._send(port, _IDENTIFY)[0])
            self._due += 1
            rounds = rounds + 1 if self._one_round(port, end) else 0
        self._synchronised = self._known = True
        self.session += 1

    def _one_round(self, port: Serial, end: float) -> bool:
        """Return whether every identification that was due has come and nothing after it."""
        until = min(end, self._now() + self._times.answer_s)
        known, came, echo = self.identity, False, False
        while self._due:
            line = self._line(port, until)
            if line is None:
                self._heard = _quoted(bytes(self._buffer)) + " without an end" if self._buffer else self._heard
                if came:  # a later one answers all that came before: those that are missing were lost, or are very late
                    self._given_up, self._due = self._given_up + self._due, 0
                return False
            if line == _IDENTIFY:
                echo = True
            elif self._identified(line):
                came, until = True, min(end, self._now() + self._times.late_s)
            else:
                self._heard = _quoted(line)
        self._echo = echo
        return self._quiet(port, end) and self.identity == known

    def _unclear(self) -> LostShotError:
        """The error of a port that cannot be synchronised: it quotes what came."""
        times = self._times
        told = f"no clear answer to {_IDENTIFY} within {times.synchronise_s:g} s"
        if self._slowest_s > times.answer_s:
            told = f"{told}: {_quoted(self.identity or '')} came after {self._slowest_s:.2f} s"
            return self._gone(told, f"it within answer_s = {times.answer_s:g} s: raise answer_s")
        if self._heard:
            return self._gone(f"{told}, but {self._heard}", "its identification: is it this device and baud rate?")
        return self._gone(f"{told}: nothing came", "its identification: look at its power, its cable and the baud rate")

    def _identified(self, line: str) -> bool:
        """Return whether a line is the identification, and one fewer is due then."""
        if not (line == self.identity if self._known else _IDENTIFICATION.fullmatch(line)):
            return False
        self.identity = line
        if 0 < self._due <= len(self._asked):
            self._slowest_s = max(self._slowest_s, self._now() - self._asked[-self._due])
        if not self._due:
            self._due, self._given_up = self._given_up, 0  # none is lost, they are late
        self._due = max(0, self._due - 1)
        return True

    def _quiet(self, port: Serial, end: float) -> bool:
        """Read until nothing has come for a while; whether nothing came at all."""
        nothing, since = True, self._now()
        while (now := self._now()) - since < self._times.quiet_s and now < end:
            if self._read(port):
                nothing, since = False, self._now()
            while (line := self._next_line()) is not None:
                if not self._identified(line) and line != _IDENTIFY:
                    self._heard = _quoted(line)
        nothing = nothing and not self._buffer.strip(_NO_LINE)
        self._buffer.clear()
        return nothing

    def _line(self, port: Serial, until: float) -> str | None:
        """The next line without its end, or None where it does not end in time."""
        while (line := self._next_line()) is None and self._now() < until:
            self._read(port)
        return line

    def _next_line(self) -> str | None:
        """The next line that is not empty; between CR and LF there is an empty one."""
        del self._buffer[: len(self._buffer) - len(self._buffer.lstrip(_NO_LINE))]
        end = _END.search(self._buffer)
        length = _LONGEST_LINE if end is None else min(end.start(), _LONGEST_LINE)
        if len(self._buffer) < length:
            return None
        line = bytes(self._buffer[:length])
        del self._buffer[:length]
        return line.decode("latin-1")

    def _read(self, port: Serial) -> bool:
        """Return whether something came that belongs to a line."""
        found = port.read(max(1, port.in_waiting)).replace(b"\0", b"")
        self._buffer += found
        return bool(found.strip(_NO_LINE))

    def _gone(self, got: object, expected: object) -> LostShotError:
        return LostShotError(self.name, got, expected, Reason.TRIGGER_GONE)


def _usb_adapters() -> dict[str, tuple[object, ...]]:
    """Return the facts that tell plugged-in USB adapters apart, by their ports' paths; none that are alike in them."""
    from serial.tools import list_ports

    found = {
        port.device: (port.vid, port.pid, port.serial_number or port.location)
        for port in list_ports.comports()
        if port.vid is not None
    }
    alike = Counter(found.values())
    return {path: adapter for path, adapter in found.items() if alike[adapter] == 1}


def _words(error: BaseException) -> str:
    """Return what an exception of pyserial says, with its kind: some say little else."""
    return f"{type(error).__name__} ({error})"


def _quoted(what: str | bytes) -> str:
    """Return what came, as an error quotes it."""
    text = what if isinstance(what, str) else what.decode("latin-1")
    return repr(text) if len(text) <= _QUOTED else f"{text[:_QUOTED]!r} and {len(text) - _QUOTED} characters more"
