"""A virtual serial port carries lines, keeps its address, and goes wrong as it is told."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from lightpage.errors import LightpageError
from runtime.virtual_device.serial_port import Pty, TcpPort, VirtualSerialPort

WAIT_S = 60.0


@pytest.fixture(params=["pty", "tcp"])
def port(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[VirtualSerialPort]:
    made: VirtualSerialPort = Pty(str.upper, tmp_path / "tty") if request.param == "pty" else TcpPort(str.upper)
    with made:
        yield made


def ask(port: VirtualSerialPort, content: bytes, answer: bytes) -> bool:
    """Whether this answer comes."""
    with serial.serial_for_url(port.address, timeout=WAIT_S) as driver:
        driver.write(content)
        return bytes(driver.read(len(answer))) == answer


def test_lines_are_answered_in_order_and_echoed_if_told(port: VirtualSerialPort) -> None:
    assert ask(port, b"one\r\ntwo\r\nthr", b"ONE\r\nTWO\r\n")
    port.unplug()
    port.plug()
    port.echo = True
    assert ask(port, b"one\r\n", b"one\r\nONE\r\n")


def test_unplugged_it_is_gone_and_plugged_it_is_back(port: VirtualSerialPort) -> None:
    driver = serial.serial_for_url(port.address, timeout=WAIT_S)
    driver.write(b"one\r\n")
    assert driver.read(5) == b"ONE\r\n"
    address = port.address
    port.unplug()
    port.unplug()
    with pytest.raises(OSError, match=r"."):
        driver.read(1)
    driver.close()
    with pytest.raises(serial.SerialException):
        serial.serial_for_url(address, timeout=0.1)
    port.plug()
    assert port.address == address
    assert ask(port, b"one\r\n", b"ONE\r\n")


def test_an_address_that_cannot_be_had(tmp_path: Path) -> None:
    with pytest.raises(LightpageError, match=r"^serial port"):
        Pty(str.upper, tmp_path / "missing" / "tty").plug()
    with TcpPort(str.upper) as port, pytest.raises(LightpageError, match=r"^serial port"):
        TcpPort(str.upper, int(port.address.rpartition(":")[2])).plug()
    assert not os.listdir(tmp_path)
