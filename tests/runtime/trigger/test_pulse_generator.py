"""The pulse generator is set up, read back, and fires only what was set up."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from lightpage.errors import InvalidInputError
from runtime.errors import LostShotError, Reason, SourceError
from runtime.trigger.pulse_generator import PulseGenerator, PulseGeneratorSettings
from runtime.trigger.trigger import Trigger
from runtime.virtual_device.pulse_generator import IDENTITY, PulseGeneratorEmulator
from runtime.virtual_device.serial_port import Fault, Pty

FAST = {"answer_s": 0.15, "quiet_s": 0.03, "late_s": 0.4, "synchronise_s": 1.0}


class Lab:
    def __init__(self, folder: Path) -> None:
        self.fired: list[int] = []
        self.device = PulseGeneratorEmulator({1: lambda: self.fired.append(1), 2: lambda: self.fired.append(2)})
        self.port = Pty(self.device.answer, folder / "tty")
        self._made: list[PulseGenerator] = []

    def generator(self, **settings: Any) -> PulseGenerator:
        made = PulseGenerator(PulseGeneratorSettings(port=self.port.address, **FAST | settings))
        self._made.append(made)
        return made

    def close(self) -> None:
        for generator in self._made:
            generator.close()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    made = Lab(tmp_path)
    with made.port:
        yield made
        made.close()


@pytest.mark.parametrize("fire", ["single", "software"])
@pytest.mark.parametrize("reset", [True, False])
def test_set_up_and_fired(lab: Lab, fire: str, reset: bool) -> None:
    trigger: Trigger = (generator := lab.generator(fire=fire, reset=reset, width_s=2e-4, delay_s=1e-5))
    trigger.arm()
    device = lab.device
    assert generator.identity == IDENTITY
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
        before = time.monotonic()
        assert before <= trigger.fire() <= time.monotonic()
    assert lab.fired == [1, 2, 1, 2, 1, 2]
    trigger.disarm()
    assert device.value(0, "STATe") == "0"
    with pytest.raises(LostShotError, match="arm first"):
        trigger.fire()
    assert device.shots == 3


def test_other_channels_and_polarity(lab: Lab) -> None:
    generator = lab.generator(channels=(5,), polarity="inverted")
    generator.arm()
    generator.fire()
    assert lab.fired == []
    assert (lab.device.value(5, "POLarity"), lab.device.value(5, "STATe")) == ("INV", "1")


def test_a_setting_that_is_not_taken_is_named(lab: Lab) -> None:
    answer = lab.device.answer

    def coarse(message: str) -> str:
        """A device that takes no width above 100 us, and says ok."""
        return answer(":PULSE1:WIDT 0.0001" if message.startswith(":PULSE1:WIDT ") else message)

    lab.port._answer = coarse
    with pytest.raises(SourceError, match=r":PULSE1:WIDT: got 0\.00010000000 s after 0\.00100000000 s was set"):
        lab.generator().arm()


@pytest.mark.parametrize(
    ("setting", "instead"),
    [(":PULSE0:MODE SING", ":PULSE0:MODE NORM"), (":PULSE2:STATE ON", ":PULSE2:STATE OFF")],
)
def test_words_and_states_are_read_back(lab: Lab, setting: str, instead: str) -> None:
    answer: Callable[[str], str] = lab.device.answer
    lab.port._answer = lambda message: answer(instead if message == setting else message)
    with pytest.raises(SourceError, match=setting.split()[0]):
        lab.generator().arm()


def test_a_refused_setting_is_named(lab: Lab) -> None:
    answer: Callable[[str], str] = lab.device.answer
    lab.port._answer = lambda message: "?3" if ":DELAY" in message else answer(message)
    with pytest.raises(SourceError, match=r"\?3 \(invalid keyword\) to :PULSE1:DELAY"):
        lab.generator().arm()


def test_a_refused_shot(lab: Lab) -> None:
    generator = lab.generator()
    generator.arm()
    answer: Callable[[str], str] = lab.device.answer
    lab.port._answer = lambda message: "?8" if message == ":PULSE0:STATE ON" else answer(message)
    with pytest.raises(LostShotError, match="not possible in the present state") as raised:
        generator.fire()
    assert raised.value.reason is Reason.TRIGGER_REFUSED
    lab.port._answer = answer
    generator.fire()
    assert lab.device.shots == 1


def test_no_line_and_no_device(lab: Lab, tmp_path: Path) -> None:
    missing = PulseGenerator(PulseGeneratorSettings(port=str(tmp_path / "none"), **FAST))
    with pytest.raises(SourceError, match="none"):
        missing.arm()
    missing.close()
    lab.port.fault = lambda message: Fault.SILENCE
    with pytest.raises(SourceError, match="no clear answer"):
        lab.generator().arm()


def test_nothing_is_fired_until_it_is_set_up_again(lab: Lab) -> None:
    generator = lab.generator()
    generator.arm()
    generator.set_channel(3, True)
    lab.port.unplug()
    lab.device.power_cycle()
    lab.port.plug()
    for _ in range(2):
        with pytest.raises(LostShotError) as raised:
            generator.fire()
        assert raised.value.reason is Reason.TRIGGER_GONE
    assert (lab.device.shots, lab.device.value(0, "STATe"), lab.device.value(3, "STATe")) == (0, "0", "0")
    generator.arm()
    generator.fire()
    assert (lab.fired, lab.device.value(3, "STATe")) == ([1, 2], "1")


def test_gone_after_it_was_there(lab: Lab) -> None:
    generator = lab.generator()
    generator.arm()
    lab.port.unplug()
    with pytest.raises(LostShotError):
        generator.fire()
    with pytest.raises(LostShotError) as raised:
        generator.arm()
    assert raised.value.reason is Reason.TRIGGER_GONE
    generator.disarm()
    lab.port.plug()
    generator.arm()
    generator.fire()
    lab.port.unplug()
    generator.disarm()
    generator.close()


def test_a_shot_without_an_answer_is_lost_and_needs_a_new_set_up(lab: Lab) -> None:
    generator = lab.generator()
    generator.arm()
    lab.port.fault = lambda message: Fault.SILENCE if message == ":PULSE0:STATE ON" else None
    with pytest.raises(LostShotError, match="no answer to :PULSE0:STATE ON"):
        generator.fire()
    lab.port.fault = lambda message: None
    with pytest.raises(LostShotError, match="arm first"):
        generator.fire()
    generator.arm()
    generator.fire()
    assert lab.device.shots == 2


def test_other_channels_are_switched_without_arming(lab: Lab) -> None:
    generator = lab.generator()
    generator.set_channel(4, True)
    assert generator.channel_state(4)
    assert lab.device.value(4, "POLarity") == "INV"
    generator.set_channel(4, False)
    assert not generator.channel_state(4)


@pytest.mark.parametrize("channel", [0, 1, 9])
def test_camera_channels_and_unknown_ones_are_not_switched(lab: Lab, channel: int) -> None:
    with pytest.raises(InvalidInputError, match="channel"):
        lab.generator().set_channel(channel, True)
    if channel != 1:
        with pytest.raises(InvalidInputError, match="channel"):
            lab.generator().channel_state(channel)


@pytest.mark.parametrize(
    "settings",
    [
        {"port": ""},
        {"baud": 0},
        {"channels": ()},
        {"channels": (0,)},
        {"channels": (1, 1)},
        {"width_s": 0},
        {"width_s": float("nan")},
        {"delay_s": -1e-9},
        {"polarity": "high"},
        {"fire": "hardware"},
        {"answer_s": 0},
        {"unknown": 1},
    ],
)
def test_settings_have_bounds(settings: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=next(iter(settings))):
        PulseGeneratorSettings(**{"port": "/dev/ttyUSB0"} | settings)


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


def test_a_device_without_dividers_is_set_up_all_the_same(lab: Lab) -> None:
    answer: Callable[[str], str] = lab.device.answer
    lab.port._answer = lambda message: "?3" if ":CMOD" in message else answer(message)
    generator = lab.generator()
    generator.arm()
    generator.fire()
    assert lab.fired == [1, 2]
