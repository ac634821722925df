"""A virtual serial port carries lines, keeps its address, and goes wrong as it is told."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from lightpage.errors import LightpageError
from runtime.virtual_device.serial_port import Fault, Pty, TcpPort, VirtualSerialPort


@pytest.fixture(params=["pty", "tcp"])
def port(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[VirtualSerialPort]:
    made: VirtualSerialPort = Pty(str.upper, tmp_path / "tty") if request.param == "pty" else TcpPort(str.upper)
    with made:
        yield made


def ask(port: VirtualSerialPort, content: bytes, timeout_s: float = 0.3) -> bytes:
    with serial.serial_for_url(port.address, timeout=timeout_s) as driver:
        driver.write(content)
        return bytes(driver.read(1000))


def test_lines_are_answered_in_order(port: VirtualSerialPort) -> None:
    assert ask(port, b"one\r\ntwo\r\nthr") == b"ONE\r\nTWO\r\n"


def test_echo(port: VirtualSerialPort) -> None:
    port.echo = True
    assert ask(port, b"one\r\n") == b"one\r\nONE\r\n"


@pytest.mark.parametrize("fault", Fault)
def test_faults(port: VirtualSerialPort, fault: Fault) -> None:
    port.fault = lambda message: fault if message == "four" else None
    found = ask(port, b"four\r\nfive\r\n", 0.6)
    assert port.faults[fault] == 1
    if fault is Fault.SILENCE:
        assert found == b"FIVE\r\n"
    elif fault is Fault.LATE:
        assert found == b"FOUR\r\nFIVE\r\n"
    elif fault is Fault.MORE_LINES:
        assert found == b"FOUR\r\nFOUR\r\nFIVE\r\n"
    elif fault is Fault.CUT:
        assert found.endswith(b"FIVE\r\n")
        assert len(found) < 12
    else:
        assert found != b"FOUR\r\nFIVE\r\n"
        assert found.endswith(b"FIVE\r\n")


def test_unplugged_it_is_gone_and_plugged_it_is_back(port: VirtualSerialPort) -> None:
    address = port.address
    port.unplug()
    port.unplug()
    with pytest.raises(serial.SerialException):
        serial.serial_for_url(address, timeout=0.1)
    port.plug()
    assert port.address == address
    assert ask(port, b"one\r\n") == b"ONE\r\n"


def test_a_driver_loses_a_port_that_is_unplugged(port: VirtualSerialPort) -> None:
    driver = serial.serial_for_url(port.address, timeout=0.3)
    driver.write(b"one\r\n")
    assert driver.read(5) == b"ONE\r\n"
    port.unplug()
    with pytest.raises(OSError, match=r"."):
        driver.read(1)
    driver.close()


def test_an_address_that_cannot_be_had(tmp_path: Path) -> None:
    with pytest.raises(LightpageError, match="free address"):
        Pty(str.upper, tmp_path / "missing" / "tty").plug()
    with TcpPort(str.upper) as port, pytest.raises(LightpageError, match="free address"):
        TcpPort(str.upper, int(port.address.rpartition(":")[2])).plug()
    assert not os.listdir(tmp_path)
