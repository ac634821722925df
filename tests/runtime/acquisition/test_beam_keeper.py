"""Beams are open again after whatever goes wrong, or the source says that they may not be, and tries on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from runtime.acquisition.beam_keeper import BeamKeeper
from runtime.acquisition.camera_source import CameraSource
from runtime.commands.serve import _take_dark_frames
from runtime.errors import LostShotError, Reason, SourceError
from runtime.modulator.modulator import Beams
from runtime.modulator.operator import OperatorBeams
from runtime.modulator.shutters import Shutter, ShutterBeams
from runtime.trigger.pulse_generator import PulseGenerator, PulseGeneratorSettings
from runtime.virtual_device.pulse_generator import PulseGeneratorEmulator
from runtime.virtual_device.serial_port import Fault
from tests.clock import HandClock
from tests.runtime import toy
from tests.runtime.acquisition.lab import Lab, LabModulator, pages_of, source_of
from tests.runtime.trigger.memory_port import MemoryPort
from tests.waiting import eventually


class LabBeams:
    """Two shutters; `failures` are what the next orders end with, each after the first shutter has moved."""

    name = "beams"

    def __init__(self) -> None:
        self.open = {"signal": True, "reference": True}
        self.failures: list[BaseException | None] = []
        self.orders: list[tuple[bool, bool]] = []

    def let_through(self, *, signal: bool, reference: bool) -> None:
        self.orders.append((signal, reference))
        self.open["signal"] = signal
        if self.failures and (failure := self.failures.pop(0)) is not None:
            raise failure
        self.open["reference"] = reference

    def close(self) -> None:
        pass


def lost(reason: Reason = Reason.BEAM_CONTROL_FAILED) -> LostShotError:
    return LostShotError("beams", "no answer", "ok", reason)


def keeper_of(beams: Beams, clock: HandClock | None = None) -> BeamKeeper:
    return BeamKeeper(beams, threading.RLock(), "source", clock or HandClock())


FAILURES: list[Callable[[], BaseException]] = [
    lost,
    lambda: SourceError("beams", "OFF after ON was set", "ON"),
    KeyboardInterrupt,
]


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("while_open", [False, True])
def test_both_are_open_after_every_failure(failure: Callable[[], BaseException], while_open: bool) -> None:
    beams, error = LabBeams(), failure()
    keeper = keeper_of(beams)
    if not while_open:
        beams.failures = [error]
    with pytest.raises(type(error)), keeper.blocked(signal=False, reference=False):
        raise error
    assert all(beams.open.values())
    assert keeper.trouble == ""


@pytest.mark.parametrize("failure", FAILURES)
def test_what_could_not_be_opened_is_tried_until_it_is(
    failure: Callable[[], BaseException], caplog: pytest.LogCaptureFixture
) -> None:
    beams, clock, error = LabBeams(), HandClock(), failure()
    keeper = keeper_of(beams, clock)
    beams.failures = [None, error, lost(), RuntimeError("a fault of the program"), lost()]
    expected = LostShotError if isinstance(error, SourceError) else type(error)
    with pytest.raises(expected) as raised, keeper.blocked(signal=False, reference=False):
        pass
    if isinstance(raised.value, LostShotError):
        assert raised.value.reason is Reason.BEAM_CONTROL_FAILED
    for tried, pause_s in enumerate((0.5, 1.0, 2.0, 4.0), 2):
        clock.until_somebody_waits()
        assert len(beams.orders) == tried
        clock.advance(pause_s)
        eventually(lambda tried=tried: len(beams.orders) > tried)  # type: ignore[misc]
    eventually(lambda: len(caplog.records) == 2)
    assert all(beams.open.values())
    assert beams.orders == [(False, False)] + 5 * [(True, True)]
    assert [record.levelname for record in caplog.records] == ["ERROR", "WARNING"]


def test_nobody_asks_a_person_from_another_thread() -> None:
    asked: list[str] = []

    def ask(sentence: str) -> None:
        asked.append(sentence)
        if "through" in sentence:
            raise SourceError("operator", "nobody", "somebody")

    before = threading.active_count()
    keeper = keeper_of(OperatorBeams(ask))
    with pytest.raises(LostShotError), keeper.blocked(signal=False, reference=True):
        pass
    assert keeper.trouble
    assert (threading.active_count(), len(asked)) == (before, 2)


def test_closed_it_tries_no_more() -> None:
    beams, clock = LabBeams(), HandClock()
    keeper = keeper_of(beams, clock)
    beams.failures = [None, *(lost() for _ in range(10))]
    with pytest.raises(LostShotError), keeper.blocked(signal=False, reference=True):
        pass
    clock.until_somebody_waits()
    keeper.close()
    eventually(lambda: not any(thread.name == "lightpage-beams" for thread in threading.enumerate()))
    assert keeper.trouble
    assert len(beams.orders) == 2


def test_beams_that_an_earlier_process_left_blocked_are_opened_before_the_first_shot() -> None:
    beams = LabBeams()
    beams.open["signal"] = False
    keeper = keeper_of(beams)
    for _ in range(2):
        keeper.ensure_open()
    assert beams.open == {"signal": True, "reference": True}
    assert beams.orders == [(True, True)]


def test_no_page_is_taken_while_a_beam_may_be_blocked(tmp_path: Path) -> None:
    lab = Lab()
    source, modulator = source_of(lab, pages_of(tmp_path), dark_frames=1)
    let_through, fails = modulator.let_through, [True]

    def failing(*, signal: bool, reference: bool) -> None:
        if signal and fails:
            raise lost()
        let_through(signal=signal, reference=reference)

    modulator.let_through = failing  # type: ignore[method-assign]
    with source:
        assert source.trouble() == ""
        _take_dark_frames(source)  # as the service does when it starts
        assert source.trouble()
        fired = len(lab.fired)
        with pytest.raises(LostShotError) as raised:
            source.shot(0.05, page=0)
        assert raised.value.reason is Reason.BEAM_CONTROL_FAILED
        assert len(lab.fired) == fired
        fails.clear()
        assert source.shot(5.0, page=0).page_index == 0
        assert source.trouble() == ""
        assert modulator.beams[-1] == (True, True)


def test_beams_that_are_blocked_for_a_purpose_are_no_trouble(tmp_path: Path) -> None:
    lab = Lab()
    source, _ = source_of(lab, pages_of(tmp_path), reference_frames=1)
    seen: list[str] = []
    lab.cameras[0].scene = lambda scene=lab.cameras[0].scene: (seen.append(source.trouble()), scene())[1]  # type: ignore[misc]
    with source:
        source.references()
    assert set(seen) == {""}


def test_shutters_open_when_their_generator_answers_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    level = dict.fromkeys(range(1, 9), False)
    device = PulseGeneratorEmulator(on_state=level.__setitem__)
    port, lab = MemoryPort(device.answer, monkeypatch), Lab()
    lab.clock = port.clock
    for camera in lab.cameras:
        camera.clock = port.clock
    settings = PulseGeneratorSettings(port=port.address, answer_s=0.1, quiet_s=0.02, late_s=0.2, synchronise_s=0.4)
    generator = PulseGenerator(settings, port.clock)
    beams = ShutterBeams(generator, Shutter(channel=3), Shutter(channel=4), port.clock)
    cameras, show = (lab.cameras[0], lab.cameras[1]), LabModulator(lab, toy.ToyDevice())
    source = CameraSource(toy.PROFILE, cameras, lab, show, beams, pages_of(tmp_path), clock=port.clock)
    source.arm()
    beams.let_through(signal=True, reference=True)
    port.fault = lambda message: Fault.SILENCE if ":PULSE4" in message else None
    with pytest.raises(LostShotError) as raised:
        source.dark_frames()
    assert raised.value.reason is Reason.BEAM_CONTROL_FAILED
    assert source.trouble()
    port.fault = lambda message: None
    generator.arm()  # what failed is not done once more
    assert (level[3], level[4]) == (True, True)
    eventually(lambda: port.clock.advance(1.0) or not source.trouble())
    assert (level[3], level[4]) == (True, True)
    source.close()


def test_whoever_waits_while_the_beams_are_opened_hears_of_them(tmp_path: Path) -> None:
    lab = Lab()
    source, modulator = source_of(lab, pages_of(tmp_path), reference_frames=1)
    again, leave = threading.Event(), threading.Event()

    def failing(*, signal: bool, reference: bool) -> None:
        if signal:
            if source.trouble():  # it has failed before
                again.set()
                leave.wait(60)
            raise lost()

    modulator.let_through = failing  # type: ignore[method-assign]
    with source:
        with pytest.raises(LostShotError):
            source.references()
        lab.clock.until_somebody_waits()
        lab.clock.advance(0.5)
        assert again.wait(60)
        with pytest.raises(LostShotError) as raised:
            source.shot(0.01, page=0)
        assert raised.value.reason is Reason.BEAM_CONTROL_FAILED
        leave.set()
