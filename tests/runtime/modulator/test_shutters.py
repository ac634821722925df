"""Shutters open and close as they are told, and are left open."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import ValidationError

from lightpage.errors import InvalidInputError
from runtime.errors import LostShotError, Reason
from runtime.modulator.modulator import Beams
from runtime.modulator.shutters import Shutter, ShutterBeams
from runtime.trigger.pulse_generator import PulseGenerator, PulseGeneratorSettings
from runtime.virtual_device.pulse_generator import PulseGeneratorEmulator
from runtime.virtual_device.serial_port import Fault, Pty

SIGNAL, REFERENCE = Shutter(channel=3, settle_s=0.01), Shutter(channel=4, open_when="low", settle_s=0.0)


class Lab:
    def __init__(self, folder: Path) -> None:
        self.level = {channel: False for channel in range(1, 9)}
        self.device = PulseGeneratorEmulator(on_state=self.level.__setitem__)
        self.port = Pty(self.device.answer, folder / "tty")
        self.generator = PulseGenerator(
            PulseGeneratorSettings(
                port=self.port.address, answer_s=0.15, quiet_s=0.03, late_s=0.4, synchronise_s=1.0, reset=True
            )
        )
        self.beams = ShutterBeams(self.generator, SIGNAL, REFERENCE)

    def open(self) -> tuple[bool, bool]:
        """Signal and reference, by the levels at the outputs."""
        return self.level[3], not self.level[4]


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    made = Lab(tmp_path)
    with made.port:
        yield made
        made.generator.close()


def test_both_shutters_move(lab: Lab) -> None:
    beams: Beams = lab.beams
    for signal in (False, True):
        for reference in (False, True):
            beams.let_through(signal=signal, reference=reference)
            assert lab.open() == (signal, reference)
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
    with pytest.raises(LostShotError, match="shutters on channels 3 and 4") as raised:
        lab.beams.let_through(signal=False, reference=True)
    assert raised.value.reason is Reason.BEAM_CONTROL_FAILED
    lab.beams.close()
    lab.port.plug()
    lab.beams.let_through(signal=False, reference=True)
    assert lab.open() == (False, True)


def test_beams_that_nobody_moved_are_not_said_to_be_blocked(lab: Lab, caplog: pytest.LogCaptureFixture) -> None:
    lab.port.unplug()
    with pytest.raises(LostShotError):
        lab.beams.let_through(signal=False, reference=True)
    lab.beams.close()
    assert not caplog.records
    lab.port.plug()
    lab.beams.let_through(signal=False, reference=True)
    lab.port.unplug()
    lab.beams.close()
    assert "beams may still be blocked" in caplog.text


def test_what_makes_no_sense(lab: Lab) -> None:
    with pytest.raises(InvalidInputError, match="channel 3 for both"):
        ShutterBeams(lab.generator, SIGNAL, Shutter(channel=3))
    with pytest.raises(ValidationError, match="settle_s"):
        Shutter(channel=3, settle_s=float("nan"))
    with pytest.raises(ValidationError, match="open_when"):
        Shutter(channel=3, open_when="up")  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="cameras"):
        ShutterBeams(lab.generator, Shutter(channel=1), REFERENCE).let_through(signal=True, reference=True)


@pytest.mark.parametrize("failing", [":PULSE3", ":PULSE4"])
@pytest.mark.parametrize("fault", [Fault.SILENCE, Fault.CUT_MESSAGE])
def test_an_order_that_fails_is_not_given_again(lab: Lab, failing: str, fault: Fault) -> None:
    lab.beams.let_through(signal=True, reference=True)
    lab.port.fault = lambda message: fault if message.startswith(f"{failing}:STATE") else None
    with pytest.raises(LostShotError):
        lab.beams.let_through(signal=False, reference=False)
    lab.port.fault = lambda message: None
    lab.generator.arm()
    assert lab.open() == (True, True)


def test_a_shutter_that_refuses_to_open_does_not_keep_the_other_one_closed(lab: Lab) -> None:
    lab.beams.let_through(signal=False, reference=False)
    answer = lab.device.answer
    lab.port._answer = lambda message: "?8" if message.startswith(":PULSE3:STATE O") else answer(message)
    with pytest.raises(LostShotError) as raised:
        lab.beams.let_through(signal=True, reference=True)
    assert raised.value.reason is Reason.BEAM_CONTROL_FAILED
    assert lab.open() == (False, True)
    lab.port._answer = answer
    lab.beams.close()
    assert lab.open() == (True, True)


def test_one_answer_that_is_lost_on_the_line_costs_nothing(lab: Lab) -> None:
    lab.beams.let_through(signal=True, reference=True)
    left = [":PULSE4:STATE ON"]
    lab.port.fault = lambda message: Fault.SILENCE if message in left and not left.remove(message) else None  # type: ignore[func-returns-value]
    lab.beams.let_through(signal=False, reference=False)
    assert not left
    assert lab.open() == (False, False)
