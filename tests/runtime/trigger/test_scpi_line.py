"""A serial line never gives an answer to the wrong message, and comes back by itself."""

from __future__ import annotations

import re
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from serial.tools import list_ports

from lightpage.errors import InvalidInputError
from runtime.errors import LostShotError, Reason, SourceError
from runtime.trigger.scpi_line import ScpiLine
from runtime.trigger.scpi_port import REFUSALS, LineTimes
from runtime.virtual_device.pulse_generator import IDENTITY, PulseGeneratorEmulator
from runtime.virtual_device.serial_port import Fault, Pty, TcpPort, VirtualSerialPort
from tests.runtime.cameras.scene import until

TIMES = LineTimes(answer_s=0.15, quiet_s=0.03, late_s=0.4, synchronise_s=1.5)
NUMBER = re.compile(r"\d+\.\d+")


class Lab:
    """An emulated device, its port and a line to it."""

    def __init__(self, port: VirtualSerialPort, device: PulseGeneratorEmulator) -> None:
        self.port, self.device = port, device
        self.line = ScpiLine(port.address, times=TIMES)

    def width(self, channel: int) -> float:
        return float(self.line.query(f":PULSE{channel}:WIDT?", NUMBER))

    def once(self, fault: Fault, message: str) -> None:
        """The next such message goes wrong."""
        left = [message]

        def chosen(found: str) -> Fault | None:
            if found in left:
                left.remove(found)
                return fault
            return None

        self.port.fault = chosen


@contextmanager
def plugged(port: VirtualSerialPort, device: PulseGeneratorEmulator) -> Iterator[Lab]:
    with port:
        made = Lab(port, device)
        made.line.send(":PULSE1:WIDT 0.00001")
        made.line.send(":PULSE2:WIDT 0.00002")
        yield made
        made.line.close()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    device = PulseGeneratorEmulator()
    with plugged(Pty(device.answer, tmp_path / "tty"), device) as made:
        yield made


@pytest.fixture(params=["pty", "tcp"])
def any_lab(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Lab]:
    device = PulseGeneratorEmulator()
    port = Pty(device.answer, tmp_path / "tty") if request.param == "pty" else TcpPort(device.answer)
    with plugged(port, device) as made:
        yield made


def test_commands_and_queries(any_lab: Lab) -> None:
    assert (any_lab.width(1), any_lab.width(2)) == (1e-5, 2e-5)
    assert any_lab.line.identity == IDENTITY
    before = time.monotonic()
    sent = any_lab.line.send(":PULSE1:WIDT 0.5")
    assert before <= sent <= time.monotonic()
    assert any_lab.line.session == 1


def test_echo_is_told_from_answers(lab: Lab) -> None:
    lab.port.echo = True
    assert (lab.width(1), lab.width(2)) == (1e-5, 2e-5)
    lab.port.echo = False
    with pytest.raises(LostShotError, match="echo"):
        lab.width(1)
    assert (lab.width(1), lab.width(2)) == (1e-5, 2e-5)


@pytest.mark.parametrize("number", REFUSALS)
def test_a_refusal_names_the_command_and_its_meaning(number: int, tmp_path: Path) -> None:
    def answer(message: str) -> str:
        return IDENTITY if message == "*IDN?" else f"?{number}"

    with Pty(answer, tmp_path / "tty") as port:
        line = ScpiLine(port.address, times=TIMES)
        with pytest.raises(LostShotError, match=rf"\?{number} \({REFUSALS[number]}\) to :PULSE1:STATE ON") as raised:
            line.send(":PULSE1:STATE ON")
        assert raised.value.reason is Reason.TRIGGER_REFUSED
        assert line.session == 1
        line.close()


def test_a_late_answer_is_not_the_next_ones(any_lab: Lab) -> None:
    any_lab.port.late_s = (0.2, 0.25)
    any_lab.once(Fault.LATE, ":PULSE1:WIDT?")
    with pytest.raises(LostShotError, match="no answer") as raised:
        any_lab.width(1)
    assert raised.value.reason is Reason.TRIGGER_GONE
    assert any_lab.width(2) == 2e-5
    assert any_lab.line.session == 2


def test_a_late_ok_does_not_confirm_the_next_command(lab: Lab) -> None:
    lab.port.late_s = (0.2, 0.25)
    lab.once(Fault.LATE, ":PULSE1:STATE ON")
    with pytest.raises(LostShotError, match="no answer"):
        lab.line.send(":PULSE1:STATE ON")
    lab.port.fault = lambda message: Fault.SILENCE if message == ":PULSE2:STATE ON" else None
    with pytest.raises(LostShotError, match="no answer"):
        lab.line.send(":PULSE2:STATE ON")


def test_late_identifications_are_waited_for(lab: Lab) -> None:
    """Each comes after a new one was sent; the one before is not taken for it."""
    lab.once(Fault.SILENCE, ":PULSE1:WIDT?")
    with pytest.raises(LostShotError):
        lab.width(1)
    lab.port.late_s = (0.2, 0.22)
    left = [Fault.LATE, Fault.LATE, Fault.LATE]
    lab.port.fault = lambda message: left.pop(0) if left and message == "*IDN?" else None
    assert (lab.width(2), lab.width(1)) == (2e-5, 1e-5)
    assert not left


@pytest.mark.parametrize("fault", [Fault.CUT, Fault.GARBAGE, Fault.MORE_LINES, Fault.SILENCE, Fault.CUT_MESSAGE])
def test_damaged_answers_are_lost_and_the_next_is_right(lab: Lab, fault: Fault) -> None:
    for _ in range(3):
        lab.once(fault, ":PULSE1:WIDT?")
        try:
            assert lab.width(1) == 1e-5
        except LostShotError as error:
            assert error.reason in (Reason.TRIGGER_GONE, Reason.TRIGGER_REFUSED)  # noqa: PT017
        assert lab.width(2) == 2e-5


def test_what_comes_unasked_is_no_answer(tmp_path: Path) -> None:
    device = PulseGeneratorEmulator()
    with Pty(device.answer, tmp_path / "tty") as port:
        line = ScpiLine(port.address, times=TIMES)
        line.send(":PULSE1:STATE ON")
        port._write(b"ok\r\n")
        serial = line._port._port
        assert serial is not None
        until(lambda: serial.in_waiting == len(b"ok\r\n"))  # the system hands bytes on in its own time
        port.fault = lambda message: Fault.SILENCE if message == ":PULSE2:STATE ON" else None
        with pytest.raises(LostShotError, match="no answer"):
            line.send(":PULSE2:STATE ON")
        line.close()


def test_a_command_for_a_session_is_not_sent_in_another(lab: Lab) -> None:
    session = lab.line.session
    lab.line.send(":PULSE1:STATE ON", session)
    lab.once(Fault.SILENCE, ":PULSE1:WIDT?")
    with pytest.raises(LostShotError):
        lab.width(1)
    messages = lab.device.messages
    for _ in range(2):
        with pytest.raises(LostShotError, match="interrupted"):
            lab.line.send(":PULSE0:STATE ON", session)
    assert lab.device.messages == messages
    lab.line.send(":PULSE1:STATE ON")
    with pytest.raises(LostShotError, match="interrupted"):
        lab.line.send(":PULSE0:STATE ON", session)
    lab.line.send(":PULSE0:STATE OFF", lab.line.session)


@pytest.mark.parametrize("meanwhile", [True, False])
def test_unplugged_and_back(any_lab: Lab, meanwhile: bool) -> None:
    any_lab.port.unplug()
    if meanwhile:
        for _ in range(2):
            with pytest.raises(LostShotError) as raised:
                any_lab.width(1)
            assert raised.value.reason is Reason.TRIGGER_GONE
    any_lab.port.plug()
    assert (any_lab.width(1), any_lab.line.session) == (1e-5, 2)


@pytest.mark.parametrize("kind", [OSError, termios.error, TypeError])
def test_every_exception_of_an_unplugged_port_is_one_reason(kind: type[Exception], lab: Lab) -> None:
    class Broken:
        in_waiting = 0

        def write(self, data: bytes) -> int:
            raise kind("gone")

        def close(self) -> None:
            raise kind("gone")

    lab.line._port._port = Broken()  # type: ignore[assignment]
    with pytest.raises(LostShotError, match=kind.__name__) as raised:
        lab.line.send(":PULSE1:STATE ON")
    assert raised.value.reason is Reason.TRIGGER_GONE
    assert lab.width(1) == 1e-5


def test_unplugged_while_an_answer_is_waited_for(any_lab: Lab) -> None:
    any_lab.once(Fault.SILENCE, ":PULSE1:WIDT?")
    timer = threading.Timer(0.05, any_lab.port.unplug)
    timer.start()
    with pytest.raises(LostShotError) as raised:
        any_lab.width(1)
    timer.join(5)
    assert raised.value.reason is Reason.TRIGGER_GONE
    any_lab.port.plug()
    assert any_lab.width(1) == 1e-5


def test_a_silent_device_is_given_up_in_time(lab: Lab) -> None:
    lab.port.fault = lambda message: Fault.SILENCE
    begin = time.monotonic()
    for _ in range(2):
        with pytest.raises(LostShotError, match=r"no answer|no clear answer"):
            lab.width(1)
    assert time.monotonic() - begin < 2 * TIMES.longest_s
    lab.port.fault = lambda message: None
    assert lab.width(1) == 1e-5


def test_a_caller_waits_no_longer_than_it_wants(lab: Lab) -> None:
    lab.port.fault = lambda message: Fault.SILENCE
    with pytest.raises(LostShotError):
        lab.width(1)
    messages = lab.device.messages
    with_answers = threading.Timer(0.4, lambda: setattr(lab.port, "fault", lambda message: None))
    with_answers.start()
    with pytest.raises(LostShotError, match=r"not answered within 0\.1 s|no time left"):
        lab.line.send(":PULSE1:STATE ON", timeout_s=0.1)  # the line is still being synchronised by then
    with_answers.join(5)
    assert lab.width(1) == 1e-5
    assert lab.device.messages > messages
    assert lab.device.value(1, "STATe") == "0"  # it was not sent after its caller had left


def test_many_callers_each_get_their_own_answer(lab: Lab) -> None:
    for channel in range(1, 9):
        lab.line.send(f":PULSE{channel}:WIDT {channel}e-5")
    wrong: list[tuple[int, float]] = []

    def ask(channel: int) -> None:
        wrong.extend((channel, found) for _ in range(10) if (found := lab.width(channel)) != float(f"{channel}e-5"))

    threads = [threading.Thread(target=ask, args=(channel,)) for channel in range(1, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert wrong == []


def test_no_such_port(tmp_path: Path) -> None:
    line = ScpiLine(str(tmp_path / "none"), times=TIMES)
    with pytest.raises(LostShotError, match="none") as raised:
        line.send("*RST")
    assert raised.value.reason is Reason.TRIGGER_GONE
    line.close()
    line = ScpiLine("nonsense://x", times=TIMES)
    with pytest.raises(SourceError, match="nonsense"):
        line.send("*RST")
    line.close()


@pytest.mark.parametrize("message", ["", "*RST\r\n*TRG", "µ"])
def test_messages_are_one_line_of_ascii(message: str) -> None:
    with pytest.raises(InvalidInputError, match="ASCII"):
        ScpiLine("socket://127.0.0.1:1").send(message)


@pytest.mark.parametrize(
    ("line_end", "before", "echo"),
    [(b"\n", b"", False), (b"\r", b"\0\0", False), (b"\r", b"", True), (b"\n\r", b"\0", True)],
)
def test_a_line_ends_as_its_device_ends_it(any_lab: Lab, line_end: bytes, before: bytes, echo: bool) -> None:
    any_lab.port.line_end, any_lab.port.before_line, any_lab.port.echo = line_end, before, echo
    line = any_lab.line
    line.close()
    for _ in range(3):
        assert (any_lab.width(1), any_lab.width(2)) == (1e-5, 2e-5)
    line.send(":PULSE1:STATE ON")
    session = line.session
    for _ in range(20):
        line.send(":PULSE1:STATE OFF", session)
    assert line.identity == IDENTITY


def test_a_rest_of_an_end_that_comes_later_is_no_answer(lab: Lab) -> None:
    lab.port.line_end = b"\r"
    lab.width(1)
    session = lab.line.session
    for late in (b"\n", b"\0", b"\0\r\n"):
        lab.port._write(late)
        serial = lab.line._port._port
        assert serial is not None
        until(lambda serial=serial: serial.in_waiting > 0)  # type: ignore[misc]
        lab.line.send(":PULSE1:STATE ON", session)


def test_a_device_that_sends_nuls_all_the_time_is_understood(lab: Lab) -> None:
    lab.line.close()
    stop = threading.Event()

    def fill() -> None:
        while not stop.wait(0.005):
            lab.port._write(b"\0")

    filler = threading.Thread(target=fill)
    filler.start()
    try:
        assert lab.width(2) == 2e-5
    finally:
        stop.set()
        filler.join(5)


@pytest.mark.parametrize(
    ("answer", "line_end", "quoted"),
    [
        ("login:", b"", r"'login:' without an end"),
        ("ERROR 7", b"\n", r"'ERROR 7'"),
        ("\x80\xfe\x80", b"\r\n", r"'\\x80þ\\x80'"),
        ("x" * 300, b"\r", r"'x{80}' and 220 characters more"),
    ],
)
def test_what_came_in_place_of_an_identification_is_quoted(
    answer: str, line_end: bytes, quoted: str, tmp_path: Path
) -> None:
    with Pty(lambda message: answer, tmp_path / "tty") as port:
        port.line_end = line_end
        line = ScpiLine(port.address, times=TIMES)
        with pytest.raises(LostShotError, match=rf"\*IDN\? .*{quoted}") as raised:
            line.send("*RST")
        assert raised.value.reason is Reason.TRIGGER_GONE
        line.close()


def test_an_answer_without_an_end_is_quoted(lab: Lab) -> None:
    lab.port.line_end = b""
    with pytest.raises(LostShotError, match=r"'0\.00001000000' without an end"):
        lab.width(1)


def test_a_device_that_is_slow_is_named_as_slow_and_with_more_time_is_understood(lab: Lab) -> None:
    lab.line.close()
    lab.port.late_s = (0.2, 0.2)
    lab.port.fault = lambda message: Fault.LATE
    with pytest.raises(LostShotError, match=rf"'{IDENTITY}' came after 0\.2.* s, wanted it within answer_s"):
        lab.width(1)
    lab.port.unplug()  # what is still on its way is lost
    lab.port.plug()
    patient = ScpiLine(lab.port.address, times=LineTimes(answer_s=0.5, quiet_s=0.03, late_s=1.0, synchronise_s=4.0))
    assert float(patient.query(":PULSE1:WIDT?", NUMBER)) == 1e-5
    patient.close()


def test_a_banner_is_no_answer(lab: Lab) -> None:
    lab.line.close()
    lab.port.before_line = b"BNC 575 ready, firmware 2.4, good morning\n"
    with pytest.raises(LostShotError, match="BNC 575 ready"):
        lab.width(1)
    first = [b"BNC 575 ready, firmware 2.4, good morning\n"]
    answer = lab.device.answer

    def greeting(message: str) -> str:
        return (first.pop().decode() if first else "") + answer(message)

    lab.port.before_line, lab.port._answer = b"", greeting
    assert (lab.width(1), lab.line.identity) == (1e-5, IDENTITY)


def test_an_adapter_that_comes_back_under_another_name_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = PulseGeneratorEmulator()
    first, second = (Pty(device.answer, tmp_path / name) for name in ("ttyUSB0", "ttyUSB1"))
    plugged: dict[Path, tuple[int, int, str | None, str]] = {}

    def comports() -> list[SimpleNamespace]:
        names = ("vid", "pid", "serial_number", "location")
        known = [(link, dict(zip(names, told, strict=True))) for link, told in plugged.items()]
        return [SimpleNamespace(device=str(link.resolve()), **told) for link, told in known] + [
            SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, serial_number=None, location=None)
        ]

    monkeypatch.setattr(list_ports, "comports", comports)
    with first:
        plugged[tmp_path / "ttyUSB0"] = (0x403, 0x6001, "A50", "1-1")
        line = ScpiLine(first.address, times=TIMES)
        line.send(":PULSE1:WIDT 0.00001")
    del plugged[tmp_path / "ttyUSB0"]
    with second:
        plugged[tmp_path / "ttyUSB1"] = (0x403, 0x6001, "B77", "1-2")  # another one
        with pytest.raises(LostShotError, match="ttyUSB0"):
            line.send(":PULSE1:STATE ON")
        plugged[tmp_path / "ttyUSB1"] = (0x403, 0x6001, "A50", "1-2")
        line.send(":PULSE1:STATE ON")
        assert line.session == 2
        line.close()
