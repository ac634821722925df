"""The pulse generator is set up, read back, and fires only what was set up."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from lightpage.errors import InvalidInputError
from runtime.errors import LostShotError, Reason, SourceError
from runtime.trigger.pulse_generator import PulseGenerator, PulseGeneratorSettings
from runtime.trigger.trigger import Trigger
from runtime.virtual_device.pulse_generator import IDENTITY, PulseGeneratorEmulator
from runtime.virtual_device.serial_port import Fault
from tests.runtime.trigger.memory_port import MemoryPort


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

    def instead(self, message: str, answer: str) -> None:
        """From now on messages that begin so are answered by this, and not heeded."""
        own = self.device.answer
        self.port.answer = lambda found: answer if found.startswith(message) else own(found)

    def altered(self, message: str, instead: str) -> None:
        """From now on this message is taken for another one."""
        own = self.device.answer
        self.port.answer = lambda found: own(instead if found.startswith(message) else found)


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    made = Lab(monkeypatch)
    yield made
    for generator in made.made:
        generator.close()


def lost(act: Any, reason: Reason = Reason.TRIGGER_GONE) -> None:
    with pytest.raises(LostShotError) as raised:
        act()
    assert raised.value.reason is reason


@pytest.mark.parametrize("fire", ["single", "software"])
@pytest.mark.parametrize("reset", [True, False])
def test_set_up_and_fired(lab: Lab, fire: str, reset: bool) -> None:
    lab.device.answer(":PULSE7:STATE ON")
    trigger: Trigger = (generator := lab.generator(fire=fire, reset=reset, width_s=2e-4, delay_s=1e-5))
    assert not generator.reached
    trigger.arm()
    device = lab.device
    assert (generator.identity, generator.reached) == (IDENTITY, True)
    assert generator.channel_state(7) is not reset
    assert [device.value(0, "MODe"), device.value(0, "STATe")] == ["SING", "0"]
    assert device.value(0, "TRIGger:MODe") == ("DIS" if fire == "single" else "TRIG")
    for channel in (1, 2):
        assert float(device.value(channel, "WIDTh")) == 2e-4
        assert float(device.value(channel, "DELay")) == 1e-5
        assert device.value(channel, "POLarity") == "NORM"
        assert generator.channel_state(channel)
    assert not generator.channel_state(3)
    assert lab.fired == []
    for _ in range(3):
        assert trigger.fire() == lab.port.clock.now()
    assert lab.fired == [1, 2, 1, 2, 1, 2]
    trigger.disarm()
    assert [device.value(channel, "STATe") for channel in range(3)] == ["0", "0", "0"]
    lost(trigger.fire)
    assert device.shots == 3


def test_other_channels_and_polarity(lab: Lab) -> None:
    generator = lab.generator(channels=(5,), polarity="inverted")
    generator.arm()
    generator.fire()
    assert lab.fired == []
    assert (lab.device.value(5, "POLarity"), lab.device.value(5, "STATe")) == ("INV", "1")


@pytest.mark.parametrize(
    ("setting", "instead"),
    [
        (":PULSE1:WIDT ", ":PULSE1:WIDT 0.00100002"),
        (":PULSE0:MODE SING", ":PULSE0:MODE NORM"),
        (":PULSE2:STATE ON", ":PULSE2:STATE OFF"),
    ],
)
def test_a_setting_that_is_not_taken_is_named(lab: Lab, setting: str, instead: str) -> None:
    lab.altered(setting, instead)
    with pytest.raises(SourceError, match=setting.split()[0]):
        lab.generator().arm()
    lab.instead(setting, "?3")
    with pytest.raises(SourceError, match=setting.split()[0]):
        lab.generator().arm()
    lab.altered(":PULSE1:WIDT ", ":PULSE1:WIDT 0.001000009")  # as its resolution rounds it
    lab.generator().arm()
    lab.instead(":PULSE1:CMOD", "?3")  # it has no dividers
    lab.generator().arm()


def test_a_refused_shot_needs_no_new_set_up(lab: Lab) -> None:
    generator = lab.generator()
    generator.arm()
    lab.instead(":PULSE0:STATE ON", "?8")
    lost(generator.fire, Reason.TRIGGER_REFUSED)
    lab.port.answer = lab.device.answer
    generator.fire()
    assert lab.device.shots == 1


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


def test_a_shot_without_an_answer_is_lost_and_needs_a_new_set_up(lab: Lab) -> None:
    generator = lab.generator()
    generator.arm()
    lab.port.fault = lambda message: Fault.SILENCE if message == ":PULSE0:STATE ON" else None
    lost(generator.fire)
    lab.port.fault = lambda message: None
    lost(generator.fire)
    generator.arm()
    generator.fire()
    assert lab.device.shots == 2


def test_other_channels_are_switched_without_arming(lab: Lab) -> None:
    generator = lab.generator()
    generator.set_channel(4, True)
    assert generator.channel_state(4)
    assert lab.device.value(4, "POLarity") == "INV"
    assert float(lab.device.value(4, "WIDTh")) == 1e-8
    generator.set_channel(4, False)
    assert not generator.channel_state(4)


@pytest.mark.parametrize("channel", [0, 1, 9])
def test_camera_channels_and_unknown_ones_are_not_switched(lab: Lab, channel: int) -> None:
    with pytest.raises(InvalidInputError):
        lab.generator().set_channel(channel, True)
    if channel != 1:
        with pytest.raises(InvalidInputError):
            lab.generator().channel_state(channel)
    assert lab.device.messages == 0
    lab.generator().set_channel(8, True)


def test_a_divider_that_somebody_has_set_is_taken_back(lab: Lab) -> None:
    generator = lab.generator()
    generator.arm()
    lab.device.answer(":PULSE2:CMOD DCYC")
    generator.fire()
    assert lab.fired == [1]
    generator.arm()
    for _ in range(2):
        generator.fire()
    assert lab.fired[1:] == [1, 2, 1, 2]
