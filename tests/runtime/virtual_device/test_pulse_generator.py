"""The emulated pulse generator answers as the manual says, and fires when the real one would."""

from __future__ import annotations

import pytest

from runtime.virtual_device.pulse_generator import IDENTITY, PulseGeneratorEmulator


@pytest.mark.parametrize(
    ("message", "answer"),
    [
        ("*IDN?", IDENTITY),
        (":PULSE1:WIDT 0.001", "ok"),
        (":puls1:width 1e-3", "ok"),
        (":PULSe8:DELay?", "0.00000000000"),
        (":PULSE0:TRIG:MODE TRIGGERED", "ok"),
        (":SPULSE:TRIGGER:MODE?", "DIS"),
        ("PULSE1:WIDT?", "?1"),
        (":", "?2"),
        (":PULSE9:STATE ON", "?3"),
        (":PULSE1:WIDE 1", "?3"),
        (":PULSE1:WIDT", "?4"),
        (":PULSE1:WIDT nan", "?5"),
        (":PULSE1:WIDT 1e4", "?5"),
        (":PULSE0:MODE SI", "?5"),
        ("*IDN", "?6"),
        ("*TRG?", "?7"),
        ("*TRG", "?8"),
    ],
)
def test_grammar(message: str, answer: str) -> None:
    assert PulseGeneratorEmulator().answer(message) == answer


def test_what_is_set_is_answered_until_it_is_reset() -> None:
    device = PulseGeneratorEmulator()
    for message in (":PULSE3:WIDTH 0.002", ":PULSE3:POL inverted", ":PULSE3:STATE ON"):
        assert device.answer(message) == "ok"
    found = [device.answer(f":PULS3:{name}?") for name in ("WIDT", "POL", "STAT")]
    assert found == ["0.00200000000", "INV", "1"]
    assert device.answer("*RST") == "ok"
    assert [device.answer(f":PULS3:{name}?") for name in ("POL", "STAT")] == ["NORM", "0"]


def test_single_shots_reach_the_channels_that_are_on() -> None:
    fired: list[int] = []
    device = PulseGeneratorEmulator({1: lambda: fired.append(1), 2: lambda: fired.append(2)})
    device.answer(":PULSE2:STATE ON")
    device.answer(":PULSE0:STATE ON")
    assert fired == []  # a train of pulses is no single shot
    device.answer(":PULSE0:STATE OFF")
    device.answer(":PULSE0:MODE SING")
    device.answer(":PULSE0:STATE ON")
    assert (fired, device.answer(":PULSE0:STATE?")) == ([2], "0")


def test_edges_fire_a_clock_that_waits_for_them() -> None:
    fired: list[int] = []
    device = PulseGeneratorEmulator({1: lambda: fired.append(1)})
    for message in (":PULSE1:STATE ON", ":PULSE0:MODE SING", ":PULSE0:TRIG:MODE TRIG"):
        device.answer(message)
    device.external_edge()
    assert (device.answer("*TRG"), device.shots) == ("?8", 0)
    device.answer(":PULSE0:STATE ON")
    assert device.shots == 0
    assert device.answer("*TRG") == "ok"
    device.external_edge()
    assert fired == [1, 1]


def test_changes_of_channels_are_told_once() -> None:
    told: list[tuple[int, bool]] = []
    device = PulseGeneratorEmulator(on_state=lambda channel, on: told.append((channel, on)))
    for word in ("ON", "1", "OFF", "ON"):
        device.answer(f":PULSE4:STATE {word}")
    device.answer(":PULSE0:STATE ON")
    device.power_cycle()
    assert told == [(4, True), (4, False), (4, True), (4, False)]
