"""A serial line never gives an answer to the wrong message, comes back by itself, and many callers share it."""

import re
import termios
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from serial.tools import list_ports

from lightpage.errors import LostShotError, Reason, SourceError
from lightpage.runtime.device.trigger.scpi_line import ScpiLine
from lightpage.runtime.device.trigger.scpi_port import LineTimes, ScpiPort
from lightpage.virtual_device.pulse_generator import IDENTITY, PulseGeneratorEmulator
from lightpage.virtual_device.serial_port import Fault, Pty, TcpPort, VirtualSerialPort
from tests.runtime.device.acquisition.lab import reason_of
from tests.runtime.device.trigger.memory_port import TIMES, MemoryDriver, MemoryPort

NUMBER, DONE = re.compile(r"\d+\.\d+"), re.compile("ok")
GREETING = "BNC 575 ready, firmware 2.4, good morning"


class Lab:
    """An emulated device, whose first two widths are known, and a port to it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.device = PulseGeneratorEmulator()
        self.line = MemoryPort(self.device.answer, monkeypatch)
        self.clock = self.line.clock
        self.port = self.opened()
        for channel in (1, 2):
            self.send(f":PULSE{channel}:WIDT {channel}e-5")

    def opened(self, times: LineTimes = TIMES) -> ScpiPort:
        return ScpiPort(self.line.address, 9600, times, self.clock)

    def width(self, channel: int) -> float:
        return float(self.port.ask_twice(f":PULSE{channel}:WIDT?", NUMBER, None, self.clock.now() + 60))

    def send(self, message: str, session: int | None = None, within_s: float = 60.0) -> float:
        return self.port.ask(message, DONE, session, self.clock.now() + within_s)[1]

    def once(self, fault: Fault, *messages: str) -> None:
        """The next such message goes wrong."""
        left = list(messages)

        def chosen(found: str) -> Fault | None:
            if found in left:
                left.remove(found)
                return fault
            return None

        self.line.fault = chosen

    def lost(self) -> str:
        """What is said of a width that cannot be had."""
        with pytest.raises(LostShotError) as raised:
            self.width(1)
        assert raised.value.reason is Reason.TRIGGER_GONE
        return raised.value.got

    def unsent(self, message: str, session: int | None = None, within_s: float = 60.0) -> None:
        """A command that nothing confirms."""
        assert reason_of(lambda: self.send(message, session, within_s)) is Reason.TRIGGER_GONE

    def works(self) -> bool:
        return (self.width(1), self.width(2)) == (1e-5, 2e-5)


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Lab:
    return Lab(monkeypatch)


def test_a_message_was_sent_in_the_middle_of_its_sending_and_before_its_answer(lab: Lab) -> None:
    assert lab.works()
    assert (lab.port.identity, lab.port.session) == (IDENTITY, 1)
    begun, sending_s = lab.clock.now(), 10 * len(":PULSE1:STATE ON\r\n") / 9600
    assert lab.send(":PULSE1:STATE ON") - begun == 0  # it is answered at once
    lab.line.answer_s = 0.1
    begun = lab.clock.now()
    assert lab.send(":PULSE1:STATE ON") - begun == pytest.approx(sending_s / 2)


def test_a_connection_is_synchronised_by_two_identifications_after_silence(lab: Lab) -> None:
    lab.port.close()
    assert lab.line.driver is None
    messages, begun = lab.device.messages, lab.clock.now()
    assert lab.width(1) == 1e-5
    assert lab.device.messages == messages + 2 + 2
    assert lab.clock.now() - begun == pytest.approx(4 * 0.04)  # two silences before, two after, each by steps of 20 ms


def test_echo_is_told_from_answers(lab: Lab) -> None:
    lab.line.echo = True
    assert lab.works()
    lab.line.echo = False
    assert "echo" in lab.lost()
    assert lab.works()


def test_a_refusal_disturbs_nothing_and_a_digit_that_the_line_alters_shows(lab: Lab) -> None:
    answers = iter(["?8", "0.00001000000", "0.00003000000"])
    lab.line.answer = lambda message: next(answers)
    assert reason_of(lambda: lab.send(":PULSE1:STATE ON")) is Reason.TRIGGER_REFUSED
    assert "0.00003" in lab.lost()
    assert lab.port.session == 1
    lab.line.answer = lab.device.answer
    assert lab.works()
    assert lab.port.session == 2


def test_a_late_answer_is_not_the_next_ones(lab: Lab) -> None:
    lab.line.late_s = (0.2, 0.25)
    lab.once(Fault.LATE, ":PULSE1:WIDT?")
    begun = lab.clock.now()
    lab.lost()
    assert TIMES.answer_s <= lab.clock.now() - begun < TIMES.answer_s + 0.02
    assert lab.width(2) == 2e-5
    assert lab.port.session == 2
    lab.once(Fault.LATE, ":PULSE1:STATE ON")
    lab.unsent(":PULSE1:STATE ON")
    lab.line.fault = lambda message: Fault.SILENCE if message == ":PULSE2:STATE ON" else None
    lab.unsent(":PULSE2:STATE ON")  # the late `ok` of the one before does not confirm it
    lab.line.send(b"ok\r\n")
    lab.unsent(":PULSE2:STATE ON")  # nor one that comes unasked


@pytest.mark.parametrize("late_s", [0.2, 0.35])
def test_late_identifications_are_waited_for(lab: Lab, late_s: float) -> None:
    """Each comes after a new one was sent; the one before is not taken for it."""
    lab.once(Fault.SILENCE, ":PULSE1:WIDT?")
    lab.lost()
    lab.line.late_s = (late_s, late_s)
    lab.once(Fault.LATE, "*IDN?", "*IDN?", "*IDN?")
    assert lab.works()
    assert lab.line.faults[Fault.LATE] == 3


@pytest.mark.parametrize("fault", sorted(set(Fault) - {Fault.LATE}))
def test_damaged_answers_are_lost_and_the_next_is_right(lab: Lab, fault: Fault) -> None:
    for _ in range(20):
        lab.once(fault, ":PULSE1:WIDT?")
        try:
            assert lab.width(1) == 1e-5
        except LostShotError as error:
            assert error.reason in (Reason.TRIGGER_GONE, Reason.TRIGGER_REFUSED)  # noqa: PT017
        assert lab.width(2) == 2e-5


def test_a_command_for_a_session_is_not_sent_in_another(lab: Lab) -> None:
    session = lab.port.session
    lab.send(":PULSE1:STATE ON", session)
    lab.once(Fault.SILENCE, ":PULSE1:WIDT?")
    lab.lost()
    messages = lab.device.messages
    for _ in range(2):
        lab.unsent(":PULSE0:STATE ON", session)
    assert lab.device.messages == messages
    lab.send(":PULSE1:STATE ON")
    lab.unsent(":PULSE0:STATE ON", session)
    lab.send(":PULSE0:STATE OFF", lab.port.session)


def test_nothing_is_sent_after_its_deadline(lab: Lab) -> None:
    lab.once(Fault.SILENCE, ":PULSE1:WIDT?")
    lab.lost()
    lab.unsent(":PULSE1:STATE ON", within_s=0.1)  # the line is still being synchronised by then
    assert lab.device.value(1, "STATe") == "0"
    lab.send(":PULSE1:STATE ON", within_s=0.0)
    assert lab.device.value(1, "STATe") == "1"


def test_unplugged_and_back_whatever_pyserial_makes_of_it(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    for session, noticed in ((2, 0), (3, 2)):
        lab.line.unplug()
        for _ in range(noticed):
            lab.lost()
        lab.line.plug()
        assert lab.works()
        assert lab.port.session == session
    for error in (OSError("gone"), termios.error("gone"), TypeError("gone")):
        with monkeypatch.context() as broken:
            for call in ("write", "close"):
                broken.setattr(MemoryDriver, call, Mock(side_effect=error))
            assert type(error).__name__ in lab.lost()
        assert lab.works()


def test_a_silent_device_is_given_up_in_time(lab: Lab) -> None:
    lab.line.fault = lambda message: Fault.SILENCE
    lab.lost()
    begun = lab.clock.now()
    lab.lost()
    assert TIMES.synchronise_s < lab.clock.now() - begun < TIMES.synchronise_s + 0.2
    lab.line.fault = lambda message: None
    assert lab.works()


def test_no_such_port(lab: Lab) -> None:
    for address, kind in (("/dev/none", LostShotError), ("nonsense://x", SourceError)):
        port = ScpiPort(address, 9600, TIMES, lab.clock)
        with pytest.raises(kind) as raised:
            port.ask("*RST", DONE, None, lab.clock.now() + 60)
        assert raised.value.subject == f"pulse generator {address}"


@pytest.mark.parametrize(
    ("line_end", "before", "echo"), [(b"\n", b"", False), (b"\r", b"\0\0", False), (b"\n\r", b"\0", True)]
)
def test_a_line_ends_as_its_device_ends_it(lab: Lab, line_end: bytes, before: bytes, echo: bool) -> None:
    lab.line.line_end, lab.line.before_line, lab.line.echo = line_end, before, echo
    lab.port.close()
    for _ in range(3):
        assert lab.works()
    lab.send(":PULSE1:STATE ON")
    session = lab.port.session
    for _ in range(20):
        lab.send(":PULSE1:STATE OFF", session)


def test_a_rest_of_an_end_and_nuls_are_no_answer(lab: Lab) -> None:
    lab.line.line_end = b"\r"
    lab.width(1)
    session = lab.port.session
    for late in (b"\n", b"\0", b"\0\r\n"):
        lab.line.send(late)
        lab.send(":PULSE1:STATE ON", session)
    lab.port.close()
    for number in range(400):
        lab.line.send(b"\0", 0.005 * number)
    assert lab.width(2) == 2e-5


def test_what_came_in_place_of_an_identification_is_quoted(lab: Lab) -> None:
    for answer, line_end, quoted in (("login:", b"", "'login:'"), ("x" * 300, b"\r", f"'{80 * 'x'}' and 220")):
        lab.port.close()
        lab.line.line_end, lab.line.answer = line_end, lambda message, answer=answer: answer  # type: ignore[misc]
        assert quoted in lab.lost()
    lab.line.line_end, lab.line.answer = b"\n", lab.device.answer
    assert lab.works()
    lab.line.line_end = b""
    assert "'0.00001000000'" in lab.lost()


def test_a_device_that_is_slow_is_named_as_slow_and_with_more_time_is_understood(lab: Lab) -> None:
    lab.port.close()
    lab.line.answer_s = 0.2
    told = lab.lost()
    assert IDENTITY in told
    assert "0.20 s" in told
    lab.line.unplug()  # what is still on its way is lost
    lab.line.plug()
    lab.port = lab.opened(LineTimes(answer_s=0.5, quiet_s=0.03, late_s=1.0, synchronise_s=4.0))
    assert lab.works()


def test_a_banner_is_no_answer(lab: Lab) -> None:
    lab.port.close()
    lab.line.before_line = GREETING.encode() + b"\n"
    assert GREETING in lab.lost()
    first = [GREETING + "\n"]
    lab.line.before_line = b""
    lab.line.answer = lambda message: (first.pop() if first else "") + lab.device.answer(message)
    assert lab.works()
    assert lab.port.identity == IDENTITY


def test_an_adapter_that_comes_back_under_another_name_is_found(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    plugged: dict[str, tuple[str | None, str]] = {}

    def comports() -> list[SimpleNamespace]:
        none = SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, serial_number=None, location=None)
        return [none] + [
            SimpleNamespace(device=device, vid=0x403, pid=0x6001, serial_number=serial, location=location)
            for device, (serial, location) in plugged.items()
        ]

    monkeypatch.setattr(list_ports, "comports", comports)
    plugged["/dev/ttyUSB0"] = ("A50", "1-1")
    lab.port.close()
    assert lab.works()
    lab.line.unplug()
    lab.line.path = "/dev/ttyUSB1"
    lab.line.plug()
    del plugged["/dev/ttyUSB0"]
    plugged["/dev/ttyUSB1"] = ("B77", "1-2")  # another one
    assert "/dev/ttyUSB0" in lab.lost()
    plugged["/dev/ttyUSB1"] = ("A50", "1-2")
    assert lab.works()
    plugged["/dev/ttyUSB2"] = ("A50", "1-3")  # two that are alike: nobody knows which
    lab.port.close()
    assert "/dev/ttyUSB0" in lab.lost()


PATIENT = LineTimes(answer_s=10.0, quiet_s=0.03, late_s=10.0, synchronise_s=60.0)
"""Of a machine that may be busy."""


@pytest.fixture(params=["pty", "tcp"])
def real(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[VirtualSerialPort, ScpiLine]]:
    """A real port, which is a terminal or a socket, and a line to a device of known widths."""
    device = PulseGeneratorEmulator()
    for channel in range(1, 9):
        device.answer(f":PULSE{channel}:WIDT {channel}e-5")
    with Pty(device.answer, tmp_path / "tty") if request.param == "pty" else TcpPort(device.answer) as port:
        line = ScpiLine(port.address, times=PATIENT)
        yield port, line
        line.close()


def width_of(line: ScpiLine, channel: int = 1) -> float:
    return float(line.query(f":PULSE{channel}:WIDT?", NUMBER))


def test_many_callers_each_get_their_own_answer(real: tuple[VirtualSerialPort, ScpiLine]) -> None:
    _, line = real
    with ThreadPoolExecutor(8) as pool:
        found = pool.map(lambda channel: [width_of(line, channel) for _ in range(5)], range(1, 9))
    assert list(found) == [5 * [float(f"{channel}e-5")] for channel in range(1, 9)]
    assert line.session == 1


def test_unplugged_while_an_answer_is_waited_for_and_back(real: tuple[VirtualSerialPort, ScpiLine]) -> None:
    port, line = real
    assert width_of(line) == 1e-5
    asked = threading.Event()
    port.fault = lambda message: asked.set() or Fault.SILENCE  # type: ignore[func-returns-value]
    other = threading.Thread(target=lambda: asked.wait(60) and port.unplug())  # type: ignore[func-returns-value]
    other.start()
    for _ in range(2):
        assert reason_of(lambda: width_of(line)) is Reason.TRIGGER_GONE
        other.join(60)
    port.fault = lambda message: None
    port.plug()
    assert width_of(line) == 1e-5
    line.close()
    assert width_of(line) == 1e-5


def test_callers_wait_no_longer_than_the_line_may_take(monkeypatch: pytest.MonkeyPatch) -> None:
    """A message that had to wait for another one is not sent any more then."""
    device = PulseGeneratorEmulator()
    port, hangs, leave = MemoryPort(device.answer, monkeypatch), threading.Event(), threading.Event()

    def hanging(message: str) -> str:
        if message == ":PULSE2:STATE ON":
            hangs.set()
            leave.wait(60)
        return device.answer(message)

    port.answer = hanging
    line = ScpiLine(port.address, times=TIMES, clock=port.clock)
    refused: list[Reason] = []

    def impatient(channel: int) -> None:
        refused.append(reason_of(lambda: line.send(f":PULSE{channel}:STATE ON")))

    callers = [threading.Thread(target=impatient, args=(channel,)) for channel in (2, 1)]
    callers[0].start()
    assert hangs.wait(60)
    callers[1].start()
    port.clock.until_somebody_waits(2)
    port.clock.advance(TIMES.longest_s + 1.0)
    for caller in callers:
        caller.join(60)
    assert refused == 2 * [Reason.TRIGGER_GONE]
    leave.set()
    line.send(":PULSE3:STATE ON")
    assert [device.value(channel, "STATe") for channel in (1, 2, 3)] == ["0", "1", "1"]
    line.close()
