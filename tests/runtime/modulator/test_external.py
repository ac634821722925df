from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import pytest

from runtime.errors import LostShotError, Reason, SourceError
from runtime.modulator.beam_state import BeamState
from runtime.modulator.external import ExternalBeams, ExternalModulator
from runtime.modulator.operator import OperatorBeams
from tests.clock import HandClock
from tests.runtime.acquisition.lab import reason_of

SYMBOLS = np.zeros((2, 3), np.uint8)
WAIT_S = 60.0

Start = Callable[..., "Future[None]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Runs a call in another thread."""
    with ThreadPoolExecutor() as pool:
        yield pool.submit


def show(modulator: ExternalModulator, page: int, timeout_s: float = WAIT_S) -> None:
    modulator.show(SYMBOLS, 4, page, timeout_s)


def test_show_waits_until_the_controller_says_that_the_page_is_on_display(start: Start) -> None:
    modulator = ExternalModulator()
    assert modulator.wanted() is None
    shown = start(show, modulator, 5)
    assert modulator.wanted(WAIT_S) == 5
    modulator.shown(4)
    assert modulator.wanted() == 5
    assert not shown.done()
    assert not modulator.shows()
    modulator.shown(5)
    shown.result(WAIT_S)
    assert modulator.shows()
    assert modulator.wanted() is None
    modulator.shown(5)  # said twice
    assert modulator.shows()
    show(modulator, 5, 0.0)  # it needs no wait


@pytest.mark.parametrize("leave", [lambda m: m.withdrawn(), lambda m: m.shown(6), lambda m: m.close()])
def test_a_page_is_on_display_until_it_is_withdrawn_or_another_one_announced(
    leave: Callable[[ExternalModulator], None],
) -> None:
    modulator = ExternalModulator()
    modulator.shown(5)
    show(modulator, 5, 0.0)
    leave(modulator)
    assert not modulator.shows()
    modulator.shown(5)  # back again, but it was away
    assert not modulator.shows()
    show(modulator, 5)
    assert modulator.shows()


def test_a_page_that_nobody_shows_in_time_is_lost_and_named(start: Start) -> None:
    clock = HandClock()
    modulator = ExternalModulator(clock)
    shown = start(show, modulator, 7)
    clock.until_somebody_waits()
    modulator.shown(8)
    clock.advance(WAIT_S - 1)
    assert modulator.wanted() == 7
    clock.advance(1)
    with pytest.raises(LostShotError, match=r"^page 7") as lost:
        shown.result(WAIT_S)
    assert lost.value.reason is Reason.NOT_ON_DISPLAY
    assert lost.value.got.startswith("page 8")
    assert not modulator.shows()
    assert modulator.wanted() is None


def test_beams_are_waited_for_in_the_same_way(start: Start) -> None:
    beams = ExternalBeams(WAIT_S)
    moved = start(beams.let_through, signal=False, reference=True)
    assert beams.wanted(WAIT_S) == BeamState(signal=False, reference=True)
    beams.beams_set(signal=True, reference=True)
    assert not moved.done()
    beams.beams_set(signal=False, reference=True)
    moved.result(WAIT_S)
    assert beams.wanted() is None
    beams.close()
    assert beams.wanted() == BeamState(signal=True, reference=True)
    beams.beams_set(signal=True, reference=True)
    assert beams.wanted() is None
    beams.close()
    assert beams.wanted() is None


def test_beams_that_nobody_hears_of_are_named_and_open() -> None:
    beams = ExternalBeams(0.0)
    assert reason_of(lambda: beams.let_through(signal=False, reference=True)) is Reason.BEAM_CONTROL_FAILED
    beams.close()
    assert beams.wanted() is None
    beams.let_through(signal=True, reference=True)
    assert beams.wanted() is None


def test_a_controller_that_may_have_blocked_a_beam_is_asked_to_open_it(start: Start) -> None:
    clock = HandClock()
    beams = ExternalBeams(10.0, clock)
    for order in (BeamState(signal=False, reference=True), BeamState(signal=True, reference=True)):
        moved = start(beams.let_through, signal=order.signal, reference=order.reference)
        clock.until_somebody_waits()
        assert beams.wanted() == order
        clock.advance(10.0)
        with pytest.raises(LostShotError):
            moved.result(WAIT_S)
        assert beams.wanted() == BeamState(signal=True, reference=True)
    beams.beams_set(signal=True, reference=True)
    beams.let_through(signal=True, reference=True)
    assert beams.wanted() is None


def test_a_person_is_asked_for_what_is_to_change_and_for_nothing_else() -> None:
    asked: list[str] = []

    def ask(sentence: str) -> None:
        asked.append(sentence)
        if len(asked) == 1:
            raise SourceError("beams", "nobody to ask", "a terminal")

    beams = OperatorBeams(ask)
    beams.let_through(signal=True, reference=True)
    with pytest.raises(SourceError):
        beams.let_through(signal=False, reference=True)
    beams.close()  # they count as they were
    for signal, reference in ((False, True), (False, True), (True, False), (False, False)):
        beams.let_through(signal=signal, reference=reference)
    beams.close()
    beams.close()
    assert asked[1:] == [
        "Block the signal beam",
        "Let the signal beam through and block the reference beam",
        "Block the signal beam",
        "Let the signal beam through and let the reference beam through",
    ]
