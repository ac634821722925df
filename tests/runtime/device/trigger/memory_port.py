"""A serial port in memory, by a clock that tests move: no thread, no terminal, no waiting."""

from __future__ import annotations

import heapq
from collections.abc import Callable

import pytest
import serial

from lightpage.runtime.device.trigger.scpi_port import LineTimes
from lightpage.virtual_device.serial_port import VirtualSerialPort
from tests.clock import HandClock

TIMES = LineTimes(answer_s=0.15, quiet_s=0.03, late_s=0.4, synchronise_s=1.5)


class MemoryPort(VirtualSerialPort):
    """The port that pyserial opens from now on; who waits for it moves the clock. `answer` takes `answer_s`."""

    def __init__(self, answer: Callable[[str], str], monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(lambda message: self.answer(message))
        self.answer, self.answer_s, self.clock = answer, 0.0, HandClock()
        self.path = "/dev/ttyUSB0"
        self.driver: MemoryDriver | None = None
        """What works: nothing while the port is unplugged, nor what was opened before it was."""
        self._plugged = True
        self._received = bytearray()
        self._coming: list[tuple[float, int, bytes]] = []
        self._written, self._free_at = 0, 0.0
        monkeypatch.setattr(serial, "serial_for_url", self._open)

    @property
    def address(self) -> str:
        return self.path

    def plug(self) -> None:
        self._plugged = True

    def unplug(self) -> None:
        self._plugged, self.driver = False, None
        self._received.clear()
        self._coming.clear()

    def send(self, content: bytes, after_s: float = 0.0) -> None:
        """Send what nobody asked for."""
        self._written += 1
        heapq.heappush(self._coming, (self.clock.now() + after_s, self._written, content))

    def take(self, content: bytes) -> None:
        """Take what a driver writes, and answer it."""
        self._free_at = max(self._free_at, self.clock.now())
        self._take(content, self._received)

    def come(self) -> bytes:
        """What has come."""
        found = b""
        while self._coming and self._coming[0][0] <= self.clock.now():
            found += heapq.heappop(self._coming)[2]
        return found

    def wait(self, seconds: float) -> None:
        """Wait so long at most for what comes next."""
        now = self.clock.now()
        self.clock.advance(max(0.0, min([now + seconds, *(first[0] for first in self._coming[:1])]) - now))

    def _open(self, path: str, **_: object) -> MemoryDriver:
        if path.startswith("nonsense:"):
            raise ValueError(path)
        if not self._plugged or path != self.path:
            raise serial.SerialException(f"no {path}")
        self.driver = MemoryDriver(self)
        return self.driver

    def _delay(self, seconds: float) -> None:
        self._free_at += seconds

    def _write(self, content: bytes) -> None:
        self.send(content, self._free_at + self.answer_s - self.clock.now())

    def _appear(self) -> None:
        """Not called, nor are the others: there is no thread."""

    _disappear = _appear

    def _read(self) -> bytes:
        raise NotImplementedError


class MemoryDriver:
    """What a driver has of an open port."""

    def __init__(self, port: MemoryPort) -> None:
        self._port, self._ready = port, b""

    @property
    def in_waiting(self) -> int:
        if self._port.driver is not self:
            raise serial.SerialException("gone")
        self._ready += self._port.come()
        return len(self._ready)

    def read(self, most: int) -> bytes:
        if not self.in_waiting:
            self._port.wait(0.02)
        count = min(most, self.in_waiting)
        found, self._ready = self._ready[:count], self._ready[count:]
        return found

    def write(self, content: bytes) -> None:
        assert self.in_waiting >= 0
        self._port.take(content)

    def close(self) -> None:
        self._port.driver = None
