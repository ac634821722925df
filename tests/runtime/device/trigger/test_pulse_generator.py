"""The pulse generator is set up, read back, and fires only what was set up; its other channels move shutters."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from lightpage.errors import Reason, SourceError
from lightpage.runtime.device.modulator.shutters import Shutter, ShutterBeams
from lightpage.runtime.device.trigger.pulse_generator import PulseGenerator, PulseGeneratorSettings
from lightpage.runtime.device.trigger.trigger import SoftwareTrigger
from lightpage.virtual_device.pulse_generator import PulseGeneratorEmulator
from lightpage.virtual_device.serial_port import Fault
from tests.clock import HandClock
from tests.runtime.device.acquisition.lab import LabCamera, reason_of
from tests.runtime.device.trigger.memory_port import MemoryPort

SIGNAL, REFERENCE = Shutter(channel=3, settle_s=0.3), Shutter(channel=4, open_when="low", settle_s=0.0)


class Lab:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.fired: list[int] = []
        self.device = PulseGeneratorEmulator({1: lambda: self.fired.append(1), 2: lambda: self.fired.append(2)})
        self.port = MemoryPort(self.device.answer, monkeypatch)
        self.made: list[PulseGenerator] = []

    def generator(self, **settings: Any) -> PulseGenerator:
        given = PulseGeneratorSettings.model_validate({"port": self.port.address, **settings})
        self.made.append(PulseGenerator(given, self.port.clock))
        return self.made[-1]

    def instead(self, message: str, new: str) -> None:
        """From now on messages that begin so are answered by this, or are taken for this message."""
        own, other = self.device.answer, new if new.startswith("?") else None
        self.port.answer = lambda found: other or own(new) if found.startswith(message) else own(found)

    def beams(self) -> ShutterBeams:
        return ShutterBeams(self.generator(reset=True), SIGNAL, REFERENCE, self.port.clock)

    def open(self) -> tuple[bool, bool]:
        """Signal and reference, by the levels at the outputs."""
        return self.device.value(3, "STATe") == "1", self.device.value(4, "STATe") == "0"


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    made = Lab(monkeypatch)
    yield made
    for generator in made.made:
        generator.close()


def lost(act: Any, reason: Reason = Reason.TRIGGER_GONE) -> None:
    assert reason_of(act) is reason


@pytest.mark.parametrize("fire", ["single", "software"])
@pytest.mark.parametrize("reset", [True, False])
def test_set_up_and_fired(lab: Lab, fire: str, reset: bool) -> None:
    lab.device.answer(":PULSE7:STATE ON")
    trigger = lab.generator(fire=fire, reset=reset, width_s=2e-4, delay_s=1e-5)
    assert not trigger.reached
    trigger.arm()
    device = lab.device
    assert trigger.reached
    assert device.value(7, "STATe") == ("0" if reset else "1")
    assert [device.value(0, "MODe"), device.value(0, "STATe")] == ["SING", "0"]
    assert device.value(0, "TRIGger:MODe") == ("DIS" if fire == "single" else "TRIG")
    for channel in (1, 2):
        assert float(device.value(channel, "WIDTh")) == 2e-4
        assert float(device.value(channel, "DELay")) == 1e-5
        assert device.value(channel, "POLarity") == "NORM"
        assert device.value(channel, "STATe") == "1"
    assert device.value(3, "STATe") == "0"
    assert lab.fired == []
    for _ in range(2):
        assert trigger.fire() == lab.port.clock.now()
    assert lab.fired == [1, 2, 1, 2]
    device.answer(":PULSE2:CMOD DCYC")  # a divider that somebody has set
    trigger.fire()
    assert lab.fired[4:] == [1]
    trigger.arm()
    for _ in range(2):
        trigger.fire()
    assert lab.fired[5:] == [1, 2, 1, 2]
    trigger.disarm()
    assert [device.value(channel, "STATe") for channel in range(3)] == ["0", "0", "0"]
    lost(trigger.fire)
    assert device.shots == 5
    lab.generator(channels=(5,), polarity="inverted").arm()
    assert (device.value(5, "POLarity"), device.value(5, "STATe"), device.value(1, "STATe")) == ("INV", "1", "0")


@pytest.mark.parametrize(
    ("setting", "instead"),
    [
        (":PULSE1:WIDT ", ":PULSE1:WIDT 0.00100002"),
        (":PULSE0:MODE SING", ":PULSE0:MODE NORM"),
        (":PULSE2:STATE ON", ":PULSE2:STATE OFF"),
    ],
)
def test_a_setting_that_is_not_taken_is_named(lab: Lab, setting: str, instead: str) -> None:
    lab.instead(setting, instead)
    with pytest.raises(SourceError, match=setting.split()[0]):
        lab.generator().arm()
    lab.instead(setting, "?3")
    with pytest.raises(SourceError, match=setting.split()[0]):
        lab.generator().arm()
    lab.instead(":PULSE1:WIDT ", ":PULSE1:WIDT 0.001000009")  # as its resolution rounds it
    lab.generator().arm()
    lab.instead(":PULSE1:CMOD", "?3")  # it has no dividers
    lab.generator().arm()


def test_no_line_and_no_device(lab: Lab) -> None:
    with pytest.raises(SourceError, match="/dev/none"):
        lab.generator(port="/dev/none").arm()
    lab.port.fault = lambda message: Fault.SILENCE
    generator = lab.generator()
    with pytest.raises(SourceError):
        generator.arm()
    assert not generator.reached


@pytest.mark.parametrize("noticed", [True, False])
def test_nothing_is_fired_until_it_is_set_up_again(lab: Lab, noticed: bool) -> None:
    generator = lab.generator()
    generator.arm()
    generator.set_channel(3, True)
    lab.port.unplug()
    if noticed:
        lost(generator.fire)
        lost(generator.arm)
        generator.disarm()
    lab.device.power_cycle()
    lab.port.plug()
    for _ in range(2):
        lost(generator.fire)
    assert (lab.device.shots, lab.device.value(0, "STATe"), lab.device.value(3, "STATe")) == (0, "0", "0")
    generator.arm()
    generator.fire()
    assert (lab.fired, lab.device.value(3, "STATe")) == ([1, 2], "1")


def test_a_shot_without_an_answer_is_lost_and_needs_a_new_set_up_but_a_refused_one_does_not(lab: Lab) -> None:
    generator = lab.generator()
    generator.arm()
    lab.port.fault = lambda message: Fault.SILENCE if message == ":PULSE0:STATE ON" else None
    lost(generator.fire)
    lab.port.fault = lambda message: None
    lost(generator.fire)
    generator.arm()
    lab.instead(":PULSE0:STATE ON", "?8")
    lost(generator.fire, Reason.TRIGGER_REFUSED)
    lab.port.answer = lab.device.answer
    generator.fire()
    assert lab.device.shots == 2


def test_other_channels_are_switched_without_arming(lab: Lab) -> None:
    generator = lab.generator()
    for channel in (4, 8):
        generator.set_channel(channel, True)
        assert lab.device.value(channel, "STATe") == "1"
        assert lab.device.value(channel, "POLarity") == "INV"
        assert float(lab.device.value(channel, "WIDTh")) == 1e-8
        generator.set_channel(channel, False)
        assert lab.device.value(channel, "STATe") == "0"


def stuck(beams: ShutterBeams, *, signal: bool, reference: bool) -> None:
    lost(lambda: beams.let_through(signal=signal, reference=reference), Reason.BEAM_CONTROL_FAILED)


def test_both_shutters_move_and_are_left_open(lab: Lab) -> None:
    beams = lab.beams()
    for signal in (False, True):
        for reference in (False, True):
            beams.let_through(signal=signal, reference=reference)
            assert lab.open() == (signal, reference)
    begun = lab.port.clock.now()
    beams.let_through(signal=True, reference=True)
    assert lab.port.clock.now() - begun == pytest.approx(0.3, abs=0.01)
    beams.let_through(signal=False, reference=False)
    lab.made[0].close()
    beams.close()
    assert lab.open() == (True, True)


def test_shutters_stay_as_they_are_when_the_trigger_is_set_up(lab: Lab) -> None:
    beams = lab.beams()
    beams.let_through(signal=True, reference=False)
    lab.made[0].arm()
    assert lab.open() == (True, False)
    lab.made[0].fire()
    beams.let_through(signal=False, reference=True)
    lab.made[0].fire()
    assert (lab.open(), lab.device.shots) == ((False, True), 2)


def test_beams_that_nobody_moved_are_not_said_to_be_blocked(lab: Lab, caplog: pytest.LogCaptureFixture) -> None:
    beams = lab.beams()
    lab.port.unplug()
    stuck(beams, signal=False, reference=True)
    beams.close()
    assert not caplog.records
    lab.port.plug()
    beams.let_through(signal=False, reference=True)
    assert lab.open() == (False, True)
    lab.port.unplug()
    beams.close()
    assert [record.levelname for record in caplog.records] == ["WARNING"]


@pytest.mark.parametrize("failing", [":PULSE3", ":PULSE4"])
@pytest.mark.parametrize("fault", [Fault.SILENCE, Fault.CUT_MESSAGE])
def test_an_order_that_fails_is_not_given_again(lab: Lab, failing: str, fault: Fault) -> None:
    beams = lab.beams()
    beams.let_through(signal=True, reference=True)
    lab.port.fault = lambda message: fault if message.startswith(f"{failing}:STATE") else None
    stuck(beams, signal=False, reference=False)
    lab.port.fault = lambda message: None
    lab.made[0].arm()
    assert lab.open() == (True, True)


def test_a_shutter_that_refuses_to_open_does_not_keep_the_other_one_closed(lab: Lab) -> None:
    beams = lab.beams()
    beams.let_through(signal=False, reference=False)
    lab.instead(":PULSE3:STATE O", "?8")
    stuck(beams, signal=True, reference=True)
    assert lab.open() == (False, True)
    lab.port.answer = lab.device.answer
    beams.close()
    assert lab.open() == (True, True)


def test_one_answer_that_is_lost_on_the_line_costs_nothing(lab: Lab) -> None:
    beams = lab.beams()
    beams.let_through(signal=True, reference=True)
    left = [":PULSE4:STATE ON"]
    lab.port.fault = lambda message: Fault.SILENCE if message in left and not left.remove(message) else None  # type: ignore[func-returns-value]
    beams.let_through(signal=False, reference=False)
    assert not left
    assert lab.open() == (False, False)


def test_without_a_pulse_generator_every_camera_is_fired_once_and_the_shot_was_in_the_middle() -> None:
    class SlowCamera(LabCamera):
        def fire(self) -> None:
            super().fire()
            self.clock.advance(0.25)

    clock = HandClock()
    cameras = [SlowCamera(name, lambda: np.zeros((4, 4), np.uint8), clock) for name in ("first", "second")]
    trigger = SoftwareTrigger(cameras, clock.now)
    trigger.arm()
    begun = clock.now()
    assert trigger.fire() - begun == 0.25
    assert [camera.frame(1.0) is not None for camera in cameras] == [True, True]
    assert [camera.frame(0.0) for camera in cameras] == [None, None]
    cameras[1].gone = True
    lost(trigger.fire, Reason.CAMERA_GONE)
