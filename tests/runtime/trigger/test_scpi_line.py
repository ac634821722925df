"""Many callers share a serial line, which is a real one here: a terminal, or a socket."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from lightpage.errors import InvalidInputError
from runtime.errors import LostShotError, Reason
from runtime.trigger.scpi_line import ScpiLine
from runtime.trigger.scpi_port import LineTimes
from runtime.virtual_device.pulse_generator import IDENTITY, PulseGeneratorEmulator
from runtime.virtual_device.serial_port import Fault, Pty, TcpPort, VirtualSerialPort
from tests.runtime.trigger.memory_port import TIMES, MemoryPort

NUMBER = re.compile(r"\d+\.\d+")
PATIENT = LineTimes(answer_s=20.0, quiet_s=0.03, late_s=20.0, synchronise_s=60.0)
"""Of a machine that may be busy."""


class Lab:
    """An emulated device, its port and a line to it."""

    def __init__(self, port: VirtualSerialPort, device: PulseGeneratorEmulator) -> None:
        self.port, self.device = port, device
        self.line = ScpiLine(port.address, times=PATIENT)

    def width(self, channel: int) -> float:
        return float(self.line.query(f":PULSE{channel}:WIDT?", NUMBER))


@pytest.fixture(params=["pty", "tcp"])
def lab(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Lab]:
    device = PulseGeneratorEmulator()
    with Pty(device.answer, tmp_path / "tty") if request.param == "pty" else TcpPort(device.answer) as port:
        made = Lab(port, device)
        for channel in range(1, 9):
            device.answer(f":PULSE{channel}:WIDT {channel}e-5")
        yield made
        made.line.close()


def test_many_callers_each_get_their_own_answer(lab: Lab) -> None:
    wrong: list[tuple[int, float]] = []

    def ask(channel: int) -> None:
        wrong.extend((channel, found) for _ in range(5) if (found := lab.width(channel)) != float(f"{channel}e-5"))

    threads = [threading.Thread(target=ask, args=(channel,)) for channel in range(1, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert wrong == []
    assert (lab.line.identity, lab.line.session) == (IDENTITY, 1)


def test_unplugged_while_an_answer_is_waited_for_and_back(lab: Lab) -> None:
    assert lab.width(1) == 1e-5
    asked = threading.Event()
    lab.port.fault = lambda message: asked.set() or Fault.SILENCE  # type: ignore[func-returns-value]
    other = threading.Thread(target=lambda: asked.wait(60) and lab.port.unplug())  # type: ignore[func-returns-value]
    other.start()
    for _ in range(2):
        with pytest.raises(LostShotError) as raised:
            lab.width(1)
        assert raised.value.reason is Reason.TRIGGER_GONE
        other.join(60)
    lab.port.fault = lambda message: None
    lab.port.plug()
    assert lab.width(1) == 1e-5
    lab.line.close()
    assert lab.width(1) == 1e-5


def test_a_caller_waits_no_longer_than_it_wants(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its message is not sent any more, though the line is busy with another one only."""
    device = PulseGeneratorEmulator()
    port, hangs, leave = MemoryPort(device.answer, monkeypatch), threading.Event(), threading.Event()

    def hanging(message: str) -> str:
        if message == ":PULSE2:STATE ON":
            hangs.set()
            leave.wait(60)
        return device.answer(message)

    port.answer = hanging
    line = ScpiLine(port.address, times=TIMES, clock=port.clock)
    other = threading.Thread(target=line.send, args=(":PULSE2:STATE ON",))
    other.start()
    assert hangs.wait(60)
    refused: list[str] = []

    def impatient() -> None:
        try:
            line.send(":PULSE1:STATE ON", timeout_s=0.1)
        except LostShotError as error:
            refused.append(error.reason)

    caller = threading.Thread(target=impatient)
    caller.start()
    port.clock.until_somebody_waits(2)
    port.clock.advance(0.7)
    caller.join(60)
    assert refused == [Reason.TRIGGER_GONE]
    leave.set()
    other.join(60)
    line.send(":PULSE3:STATE ON")
    assert [device.value(channel, "STATe") for channel in (1, 2, 3)] == ["0", "1", "1"]
    line.close()


@pytest.mark.parametrize("message", ["", "*RST\r\n*TRG", "µ"])
def test_messages_are_one_line_of_ascii(message: str) -> None:
    with pytest.raises(InvalidInputError):
        ScpiLine("socket://127.0.0.1:1").send(message)
