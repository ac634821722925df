"""Beams are open again after whatever goes wrong, or the source says that they may not be, and tries on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from runtime.acquisition.beam_keeper import BeamKeeper
from runtime.commands.serve import _take_dark_frames
from runtime.errors import LostShotError, Reason, SourceError
from runtime.modulator.operator import OperatorBeams
from tests.clock import HandClock
from tests.runtime.acquisition.lab import Lab, pages_of, reason_of, source_of
from tests.waiting import eventually


class LabBeams:
    """Two shutters; `failures` are what the next orders end with, each after the first shutter has moved."""

    name = "beams"

    def __init__(self) -> None:
        self.open = {"signal": False, "reference": True}
        self.failures: list[BaseException | None] = []
        self.orders: list[tuple[bool, bool]] = []
        self.clock = HandClock()
        self.keeper = BeamKeeper(self, threading.RLock(), "source", self.clock)

    def let_through(self, *, signal: bool, reference: bool) -> None:
        self.orders.append((signal, reference))
        self.open["signal"] = signal
        if self.failures and (failure := self.failures.pop(0)) is not None:
            raise failure
        self.open["reference"] = reference

    def close(self) -> None:
        pass


def lost() -> LostShotError:
    return LostShotError("beams", "no answer", "ok", Reason.BEAM_CONTROL_FAILED)


FAILURES = [lost, lambda: SourceError("beams", "OFF after ON was set", "ON"), KeyboardInterrupt]


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("while_blocked", [False, True])
def test_both_are_open_after_every_failure(failure: Callable[[], BaseException], while_blocked: bool) -> None:
    beams, error = LabBeams(), failure()
    beams.keeper.ensure_open()
    assert (all(beams.open.values()), beams.orders) == (True, [(True, True)])  # an earlier process may have blocked one
    beams.keeper.ensure_open()
    assert len(beams.orders) == 1
    beams.failures = [] if while_blocked else [error]
    with pytest.raises(type(error)), beams.keeper.blocked(signal=False, reference=False):
        raise error
    assert all(beams.open.values())
    assert beams.keeper.trouble == ""


@pytest.mark.parametrize("failure", FAILURES)
def test_what_could_not_be_opened_is_tried_until_it_is(
    failure: Callable[[], BaseException], caplog: pytest.LogCaptureFixture
) -> None:
    beams, error = LabBeams(), failure()
    beams.failures = [None, error, lost(), RuntimeError("a fault of the program"), lost()]
    expected = LostShotError if isinstance(error, SourceError) else type(error)
    with pytest.raises(expected), beams.keeper.blocked(signal=False, reference=False):
        pass
    for tried, pause_s in enumerate((0.5, 1.0, 2.0, 4.0), 2):
        beams.clock.until_somebody_waits()
        assert (len(beams.orders), beams.keeper.trouble == "") == (tried, False)
        beams.clock.advance(pause_s)
        eventually(lambda tried=tried: len(beams.orders) > tried)  # type: ignore[misc]
    eventually(lambda: len(caplog.records) == 2)
    assert beams.keeper.trouble == ""
    assert beams.orders == [(False, False)] + 5 * [(True, True)]
    assert [record.levelname for record in caplog.records] == ["ERROR", "WARNING"]


def test_nobody_asks_a_person_from_another_thread() -> None:
    def ask(sentence: str) -> None:
        if "through" in sentence:
            raise SourceError("operator", "nobody", "somebody")

    before = threading.active_count()
    keeper = BeamKeeper(OperatorBeams(ask), threading.RLock(), "source")
    with pytest.raises(LostShotError), keeper.blocked(signal=False, reference=True):
        pass
    assert keeper.trouble
    assert threading.active_count() == before


def test_closed_it_tries_no_more() -> None:
    beams = LabBeams()
    beams.failures = [None, lost()]
    with pytest.raises(LostShotError), beams.keeper.blocked(signal=False, reference=True):
        pass
    beams.clock.until_somebody_waits()
    beams.keeper.close()
    eventually(lambda: not any(thread.name == "lightpage-beams" for thread in threading.enumerate()))
    assert beams.keeper.trouble
    assert len(beams.orders) == 2


def test_no_page_is_taken_while_a_beam_may_be_blocked(tmp_path: Path) -> None:
    lab = Lab()
    source, modulator = source_of(lab, pages_of(tmp_path), dark_frames=1, reference_frames=1)
    let_through, fails = modulator.let_through, [True]
    seen: list[str] = []
    edge = lab.cameras[0].edge
    lab.cameras[0].edge = lambda: (seen.append(source.trouble()), edge())  # type: ignore[assignment,method-assign,func-returns-value]

    def failing(*, signal: bool, reference: bool) -> None:
        if signal and fails:
            raise lost()
        let_through(signal=signal, reference=reference)

    modulator.let_through = failing  # type: ignore[method-assign]
    with source:
        _take_dark_frames(source)  # as the service does when it starts
        assert set(seen) == {""}  # what is blocked for a purpose is no trouble
        assert source.trouble()
        fired = len(lab.fired)
        assert reason_of(lambda: source.shot(0.05, page=0)) is Reason.BEAM_CONTROL_FAILED
        assert len(lab.fired) == fired
        fails.clear()
        assert source.shot(5.0, page=0).page_index == 0
        assert (source.trouble(), modulator.beams[-1]) == ("", (True, True))


def test_whoever_waits_for_others_waits_no_longer_than_it_wants_and_hears_of_the_beams(tmp_path: Path) -> None:
    lab = Lab()
    source, modulator = source_of(lab, pages_of(tmp_path), reference_frames=1)
    moves, leave = threading.Semaphore(0), threading.Semaphore(0)

    def failing(*, signal: bool, reference: bool) -> None:
        moves.release()
        assert leave.acquire(timeout=60)
        if signal:
            raise lost()

    modulator.let_through = failing  # type: ignore[method-assign]
    with source:
        other = threading.Thread(target=reason_of, args=(source.references,))
        other.start()
        assert moves.acquire(timeout=60)
        assert reason_of(lambda: source.shot(0.01, page=0)) is Reason.MISSING_FRAME
        leave.release(2)
        other.join(60)
        lab.clock.until_somebody_waits()
        lab.clock.advance(0.5)
        assert all(moves.acquire(timeout=60) for _ in range(2))
        assert reason_of(lambda: source.shot(0.01, page=0)) is Reason.BEAM_CONTROL_FAILED
        leave.release(100)
