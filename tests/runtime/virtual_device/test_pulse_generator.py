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


def test_single_shots_reach_the_channels_that_are_on() -> None:
    fired: list[int] = []
    told: list[tuple[int, bool]] = []
    cables = {1: lambda: fired.append(1), 2: lambda: fired.append(2)}
    device = PulseGeneratorEmulator(cables, on_state=lambda channel, on: told.append((channel, on)))
    device.answer(":PULSE2:STATE ON")
    device.answer(":PULSE0:STATE ON")
    assert fired == []  # a train of pulses is no single shot
    device.answer(":PULSE0:STATE OFF")
    device.answer(":PULSE0:MODE SING")
    device.answer(":PULSE0:STATE ON")
    assert (fired, device.answer(":PULSE0:STATE?")) == ([2], "0")
    device.answer(":PULSE2:STATE 1")
    assert device.answer("*RST") == "ok"
    assert device.answer(":PULSE2:STATE?") == "0"
    assert told == [(2, True), (2, False)]


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
