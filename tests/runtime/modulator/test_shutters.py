"""Shutters open and close as they are told, and are left open."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from pydantic import ValidationError

from lightpage.errors import InvalidInputError
from runtime.errors import LostShotError, Reason
from runtime.modulator.modulator import Beams
from runtime.modulator.shutters import Shutter, ShutterBeams
from runtime.trigger.pulse_generator import PulseGenerator, PulseGeneratorSettings
from runtime.virtual_device.pulse_generator import PulseGeneratorEmulator
from runtime.virtual_device.serial_port import Fault
from tests.runtime.trigger.memory_port import MemoryPort

SIGNAL, REFERENCE = Shutter(channel=3, settle_s=0.3), Shutter(channel=4, open_when="low", settle_s=0.0)


class Lab:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.level = dict.fromkeys(range(1, 9), False)
        self.device = PulseGeneratorEmulator(on_state=self.level.__setitem__)
        self.port = MemoryPort(self.device.answer, monkeypatch)
        settings = PulseGeneratorSettings(port=self.port.address, reset=True)
        self.generator = PulseGenerator(settings, self.port.clock)
        self.beams = ShutterBeams(self.generator, SIGNAL, REFERENCE, self.port.clock)

    def open(self) -> tuple[bool, bool]:
        """Signal and reference, by the levels at the outputs."""
        return self.level[3], not self.level[4]

    def lost(self, *, signal: bool, reference: bool) -> str:
        """What is named where the shutters do not move."""
        with pytest.raises(LostShotError) as raised:
            self.beams.let_through(signal=signal, reference=reference)
        assert raised.value.reason is Reason.BEAM_CONTROL_FAILED
        return raised.value.subject


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    made = Lab(monkeypatch)
    yield made
    made.generator.close()


def test_both_shutters_move(lab: Lab) -> None:
    beams: Beams = lab.beams
    for signal in (False, True):
        for reference in (False, True):
            beams.let_through(signal=signal, reference=reference)
            assert lab.open() == (signal, reference)
    begun = lab.port.clock.now()
    beams.let_through(signal=True, reference=True)
    assert lab.port.clock.now() - begun == pytest.approx(0.3, abs=0.01)
    beams.let_through(signal=False, reference=False)
    beams.close()
    assert lab.open() == (True, True)


def test_they_stay_as_they_are_when_the_trigger_is_set_up(lab: Lab) -> None:
    lab.beams.let_through(signal=True, reference=False)
    lab.generator.arm()
    assert lab.open() == (True, False)
    lab.generator.fire()
    lab.beams.let_through(signal=False, reference=True)
    lab.generator.fire()
    assert (lab.open(), lab.device.shots) == ((False, True), 2)


def test_they_are_opened_after_the_trigger_was_closed(lab: Lab) -> None:
    lab.generator.arm()
    lab.beams.let_through(signal=False, reference=False)
    lab.generator.close()
    lab.beams.close()
    assert lab.open() == (True, True)


def test_a_generator_that_has_gone(lab: Lab) -> None:
    lab.beams.let_through(signal=True, reference=True)
    lab.port.unplug()
    assert lab.lost(signal=False, reference=True).startswith(lab.beams.name)
    lab.beams.close()
    lab.port.plug()
    lab.beams.let_through(signal=False, reference=True)
    assert lab.open() == (False, True)


def test_beams_that_nobody_moved_are_not_said_to_be_blocked(lab: Lab, caplog: pytest.LogCaptureFixture) -> None:
    lab.port.unplug()
    lab.lost(signal=False, reference=True)
    lab.beams.close()
    assert not caplog.records
    lab.port.plug()
    lab.beams.let_through(signal=False, reference=True)
    lab.port.unplug()
    lab.beams.close()
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_what_makes_no_sense(lab: Lab) -> None:
    with pytest.raises(InvalidInputError, match=r"^shutters"):
        ShutterBeams(lab.generator, SIGNAL, Shutter(channel=3))
    with pytest.raises(ValidationError, match="settle_s"):
        Shutter(channel=3, settle_s=float("nan"))
    with pytest.raises(ValidationError, match="open_when"):
        Shutter(channel=3, open_when="up")  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError):
        ShutterBeams(lab.generator, Shutter(channel=1), REFERENCE).let_through(signal=True, reference=True)


@pytest.mark.parametrize("failing", [":PULSE3", ":PULSE4"])
@pytest.mark.parametrize("fault", [Fault.SILENCE, Fault.CUT_MESSAGE])
def test_an_order_that_fails_is_not_given_again(lab: Lab, failing: str, fault: Fault) -> None:
    lab.beams.let_through(signal=True, reference=True)
    lab.port.fault = lambda message: fault if message.startswith(f"{failing}:STATE") else None
    lab.lost(signal=False, reference=False)
    lab.port.fault = lambda message: None
    lab.generator.arm()
    assert lab.open() == (True, True)


def test_a_shutter_that_refuses_to_open_does_not_keep_the_other_one_closed(lab: Lab) -> None:
    lab.beams.let_through(signal=False, reference=False)
    answer = lab.device.answer
    lab.port.answer = lambda message: "?8" if message.startswith(":PULSE3:STATE O") else answer(message)
    lab.lost(signal=True, reference=True)
    assert lab.open() == (False, True)
    lab.port.answer = answer
    lab.beams.close()
    assert lab.open() == (True, True)


def test_one_answer_that_is_lost_on_the_line_costs_nothing(lab: Lab) -> None:
    lab.beams.let_through(signal=True, reference=True)
    left = [":PULSE4:STATE ON"]
    lab.port.fault = lambda message: Fault.SILENCE if message in left and not left.remove(message) else None  # type: ignore[func-returns-value]
    lab.beams.let_through(signal=False, reference=False)
    assert not left
    assert lab.open() == (False, False)
