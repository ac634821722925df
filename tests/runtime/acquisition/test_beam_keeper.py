"""Beams are open again after whatever goes wrong, or the source says that they may not be, and tries on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from lightpage.recording.pages import Pages
from runtime.acquisition import beam_keeper
from runtime.acquisition.beam_keeper import BeamKeeper
from runtime.acquisition.camera_source import CameraSource
from runtime.acquisition.page_store import PageStore
from runtime.commands.serve import _take_dark_frames
from runtime.errors import LostShotError, Reason, SourceError
from runtime.modulator.operator import OperatorBeams
from runtime.modulator.shutters import Shutter, ShutterBeams
from runtime.trigger.pulse_generator import PulseGenerator, PulseGeneratorSettings
from runtime.virtual_device.pulse_generator import PulseGeneratorEmulator
from runtime.virtual_device.serial_port import Fault, Pty
from tests.runtime import toy
from tests.runtime.acquisition.lab import Lab
from tests.runtime.acquisition.test_camera_source import LabModulator, pages_of, source_of
from tests.runtime.cameras.scene import until


class Beams:
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


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beam_keeper, "_FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(beam_keeper, "_LONGEST_PAUSE_S", 0.02)


FAILURES: list[Callable[[], BaseException]] = [
    lost,
    lambda: SourceError("beams", "OFF after ON was set", "ON"),
    KeyboardInterrupt,
    TimeoutError,
    SystemExit,
]


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("while_open", [False, True])
def test_both_are_open_after_every_failure(failure: Callable[[], BaseException], while_open: bool) -> None:
    beams = Beams()
    keeper = BeamKeeper(beams, threading.RLock(), "source")
    error = failure()
    if not while_open:
        beams.failures = [error]
    with pytest.raises(type(error)), keeper.blocked(signal=False, reference=False):
        raise error
    assert all(beams.open.values())
    assert keeper.trouble == ""


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("failure", FAILURES)
def test_what_could_not_be_opened_is_tried_until_it_is(
    failure: Callable[[], BaseException], caplog: pytest.LogCaptureFixture
) -> None:
    beams = Beams()
    keeper = BeamKeeper(beams, threading.RLock(), "source")
    error = failure()
    beams.failures = [None, error, lost(), RuntimeError("a fault of the program"), lost()]
    expected = LostShotError if isinstance(error, SourceError) else type(error)
    with pytest.raises(expected), keeper.blocked(signal=False, reference=False):
        pass
    until(lambda: not keeper.trouble)
    assert all(beams.open.values())
    assert beams.orders == [(False, False)] + 5 * [(True, True)]
    assert [record.levelname for record in caplog.records] == ["ERROR", "WARNING"]


def test_nobody_asks_a_person_from_another_thread() -> None:
    def ask(sentence: str) -> None:
        if "through" in sentence:
            raise SourceError("operator", "nobody", "somebody")

    keeper = BeamKeeper(OperatorBeams(ask), threading.RLock(), "source")
    with pytest.raises(LostShotError), keeper.blocked(signal=False, reference=True):
        pass
    assert keeper.trouble
    assert keeper._thread is None


@pytest.mark.usefixtures("quick")
def test_closed_it_tries_no_more() -> None:
    beams = Beams()
    keeper = BeamKeeper(beams, threading.RLock(), "source")
    beams.failures = [None, *(lost() for _ in range(1000))]
    with pytest.raises(LostShotError), keeper.blocked(signal=False, reference=True):
        pass
    thread = keeper._thread
    assert thread is not None
    keeper.close()
    thread.join(5)
    assert not thread.is_alive()
    assert keeper.trouble


def test_no_page_is_taken_while_a_beam_may_be_blocked(tmp_path: Path) -> None:
    lab = Lab()
    source, modulator = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))), dark_frames=1)
    let_through, fails = modulator.let_through, [True]

    def failing(*, signal: bool, reference: bool) -> None:
        if signal and fails:
            raise lost()
        let_through(signal=signal, reference=reference)

    modulator.let_through = failing  # type: ignore[method-assign]
    with source:
        assert source.trouble() == ""
        _take_dark_frames(source)  # as the service does when it starts
        assert "blocked" in source.trouble()
        fired = lab.fired
        with pytest.raises(LostShotError) as raised:
            source.shot(0.05, page=0)
        assert raised.value.reason is Reason.BEAM_CONTROL_FAILED
        assert lab.fired == fired
        fails.clear()
        assert source.shot(5.0, page=0).page_index == 0
        assert source.trouble() == ""
        assert modulator.beams[-1] == (True, True)


def test_beams_that_are_blocked_for_a_purpose_are_no_trouble(tmp_path: Path) -> None:
    lab = Lab()
    source, _ = source_of(lab, PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))), reference_frames=1)
    seen: list[str] = []
    poll = lab.poll
    lab.poll = lambda: (seen.append(source.trouble()), poll())[1]  # type: ignore[func-returns-value,method-assign]
    with source:
        source.references()
    assert set(seen) == {""}


@pytest.mark.usefixtures("quick")
def test_shutters_open_when_their_generator_answers_again(tmp_path: Path) -> None:
    level = dict.fromkeys(range(1, 9), False)
    device = PulseGeneratorEmulator(on_state=level.__setitem__)
    lab = Lab()
    with Pty(device.answer, tmp_path / "tty") as port:
        settings = PulseGeneratorSettings(
            port=port.address, answer_s=0.1, quiet_s=0.02, late_s=0.2, synchronise_s=0.4, reset=True
        )
        generator = PulseGenerator(settings)
        beams = ShutterBeams(generator, Shutter(channel=3, settle_s=0), Shutter(channel=4, settle_s=0))
        show = LabModulator(lab, toy.ToyDevice())
        pages = PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path)))
        source = CameraSource(toy.PROFILE, (lab.cameras[0], lab.cameras[1]), lab, show, beams, pages, name="camera:lab")
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
        until(lambda: not source.trouble())
        assert (level[3], level[4]) == (True, True)
        source.close()


def test_whoever_waits_while_the_beams_are_opened_hears_of_them(tmp_path: Path) -> None:
    source, modulator = source_of(Lab(), PageStore(toy.PROFILE, Pages.open(pages_of(tmp_path))))
    begun, leave = threading.Event(), threading.Event()

    def slow(*, signal: bool, reference: bool) -> None:
        begun.set()
        leave.wait(20)

    with source:
        source._keeper._trouble = "a beam may be blocked"
        modulator.let_through = slow  # type: ignore[method-assign]
        opening = threading.Thread(target=source._keeper.open)
        opening.start()
        assert begun.wait(20)
        with pytest.raises(LostShotError) as raised:
            source.shot(0.05, page=0)
        assert raised.value.reason is Reason.BEAM_CONTROL_FAILED
        leave.set()
        opening.join(20)


def test_beams_that_an_earlier_process_left_blocked_are_opened_before_the_first_shot() -> None:
    beams = Beams()
    beams.open["signal"] = False
    keeper = BeamKeeper(beams, threading.RLock(), "source")
    for _ in range(2):
        keeper.ensure_open()
    assert beams.open == {"signal": True, "reference": True}
    assert beams.orders == [(True, True)]
