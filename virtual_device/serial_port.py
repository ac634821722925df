"""A device's serial port that can be unplugged and goes wrong on demand: as a pseudo-terminal, or as a TCP socket."""

from __future__ import annotations

import os
import select
import socket
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Self

import numpy as np

from lightpage.errors import LightpageError

_POLL_S = 0.02
_READ_BYTES = 4096
_STOP_S = 5.0


class Fault(StrEnum):
    """Fault of a message or of its answer."""

    SILENCE = "SILENCE"
    """The answer does not come."""
    LATE = "LATE"
    """The answer, and all after it, comes later."""
    CUT = "CUT"
    """Some of the answer's bytes are lost, perhaps those of its end."""
    GARBAGE = "GARBAGE"
    """Some of the answer's bytes are altered, or bytes come before it."""
    CUT_MESSAGE = "CUT_MESSAGE"
    """Some of the message's bytes do not reach the device."""
    MORE_LINES = "MORE_LINES"
    """The answer comes twice."""


class VirtualSerialPort(ABC):
    """Bytes in, bytes out, by a thread; `Pty` and `TcpPort` say where.

    Args:
        answer: function from a line without its end to the device's answer.
        seed: seed of faults.

    Attributes:
        fault: chosen for each message; None for a sound one.
        echo: whether the port sends back what it receives.
        late_s: least and longest delay of a late answer.
        line_end: bytes that end the device's lines.
        before_line: bytes that come before each of them.
        faults: how many there were of each.
    """

    def __init__(self, answer: Callable[[str], str], seed: int = 0) -> None:
        self._answer = answer
        self._random = np.random.default_rng(seed)
        self.fault: Callable[[str], Fault | None] = lambda message: None
        self.echo = False
        self.late_s = (0.05, 0.3)
        self.line_end, self.before_line = b"\r\n", b""
        self.faults = dict.fromkeys(Fault, 0)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def plug(self) -> None:
        """Appear under the usual address.

        Raises:
            LightpageError: the address is taken, or cannot be made.
        """
        self.unplug()
        try:
            self._appear()
        except OSError as error:
            raise LightpageError(f"serial port {self.address}", error, "a free address") from None
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, name=f"virtual {self.address}", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Disappear; what was on its way is lost."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._stop.set()
        thread.join(_STOP_S)
        self._disappear()

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(self, *error: object) -> None:
        self.unplug()

    @property
    @abstractmethod
    def address(self) -> str:
        """Address that a driver is given as its port."""

    @abstractmethod
    def _appear(self) -> None: ...

    @abstractmethod
    def _disappear(self) -> None: ...

    @abstractmethod
    def _read(self) -> bytes:
        """Return the bytes that have come within a poll; empty where none have.

        Raises:
            OSError: no driver is there any more.
        """

    @abstractmethod
    def _write(self, content: bytes) -> None: ...

    def _serve(self) -> None:
        received = bytearray()
        while not self._stop.is_set():
            try:
                self._take(self._read(), received)
            except OSError:
                received.clear()
                self._stop.wait(_POLL_S)

    def _take(self, new: bytes, received: bytearray) -> None:
        """Answer the lines that are whole with what is new; the rest of `received` waits for more."""
        if self.echo and new:
            self._write(new)
        received += new
        while b"\r\n" in received:
            line, _, rest = bytes(received).partition(b"\r\n")
            received[:] = rest
            self._respond(line, received)

    def _delay(self, seconds: float) -> None:
        """Let what is written next come so much later."""
        self._stop.wait(seconds)

    def _respond(self, line: bytes, received: bytearray) -> None:
        message = line.decode("latin-1")
        fault = self.fault(message)
        if fault is not None:
            self.faults[fault] += 1
        if fault is Fault.CUT_MESSAGE:
            left = self._without_some(line + b"\r\n")
            if not left.endswith(b"\r\n"):
                received[:0] = left  # the next message goes on where this one breaks off
                return
            message = left[:-2].decode("latin-1")
        content = self.before_line + self._answer(message).encode("latin-1") + self.line_end
        if fault is Fault.SILENCE:
            return
        if fault is Fault.LATE:
            self._delay(self._random.uniform(*self.late_s))
        elif fault is Fault.CUT:
            content = self._without_some(content)
        elif fault is Fault.GARBAGE:
            content = self._spoilt(content)
        elif fault is Fault.MORE_LINES:
            content += content
        if not self._stop.is_set():
            self._write(content)

    def _without_some(self, content: bytes) -> bytes:
        first, last = sorted(self._random.choice(len(content) + 1, 2, replace=False))
        return content[:first] + content[last:]

    def _spoilt(self, content: bytes) -> bytes:
        noise = self._random.bytes(int(self._random.integers(1, 6)))
        if self._random.random() < 0.5:
            return noise + content
        start = int(self._random.integers(len(content)))
        return content[:start] + noise + content[start + len(noise) :]


class Pty(VirtualSerialPort):
    """A pseudo-terminal under a link that stays the same.

    Args:
        answer, seed: see `VirtualSerialPort`.
        link: path that points to the terminal while it is plugged.
    """

    def __init__(self, answer: Callable[[str], str], link: Path, seed: int = 0) -> None:
        super().__init__(answer, seed)
        self._link = link

    @property
    def address(self) -> str:
        """The link."""
        return str(self._link)

    def _appear(self) -> None:
        self._master, self._slave = (
            os.openpty()
        )  # the slave stays open: without, reading fails while no driver is there
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(self._slave))

    def _disappear(self) -> None:
        self._link.unlink(missing_ok=True)
        os.close(self._slave)
        os.close(self._master)

    def _read(self) -> bytes:
        return os.read(self._master, _READ_BYTES) if select.select([self._master], [], [], _POLL_S)[0] else b""

    def _write(self, content: bytes) -> None:
        os.write(self._master, content)


class TcpPort(VirtualSerialPort):
    """A socket on loopback, as of a serial device server; one driver at a time.

    Args:
        answer, seed: see `VirtualSerialPort`.
        port: 0 takes a free one, and keeps its number.
    """

    def __init__(self, answer: Callable[[str], str], port: int = 0, seed: int = 0) -> None:
        super().__init__(answer, seed)
        self._number = port
        self._driver: socket.socket | None = None

    @property
    def address(self) -> str:
        """A URL for pyserial."""
        return f"socket://127.0.0.1:{self._number}"

    def _appear(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", self._number), backlog=1)
        self._listener.settimeout(_POLL_S)
        self._number = self._listener.getsockname()[1]

    def _disappear(self) -> None:
        self._listener.close()
        self._hang_up()

    def _hang_up(self) -> None:
        driver, self._driver = self._driver, None
        if driver is not None:
            driver.close()

    def _read(self) -> bytes:
        if self._driver is None:
            try:
                self._driver, _ = self._listener.accept()
            except TimeoutError:
                return b""
            self._driver.settimeout(_POLL_S)
        try:
            found = self._driver.recv(_READ_BYTES)
        except TimeoutError:
            return b""
        except OSError:
            self._hang_up()
            raise
        if not found:
            self._hang_up()
            raise ConnectionResetError
        return found

    def _write(self, content: bytes) -> None:
        if self._driver is not None:
            self._driver.sendall(content)
