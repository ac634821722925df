"""Whom the service lets in: slots for which callers queue, sessions that are bounded, a heart that notices a hang."""

import math
import queue
from concurrent.futures import ThreadPoolExecutor

import pytest

from lightpage.errors import CallerLeft, OverloadedError, SlotsTakenError
from lightpage.runtime.service.admission import FORGET_S, Heart, Slots
from lightpage.runtime.service.caller import Caller, Sessions, named_session, own_name
from tests.clock import HandClock
from tests.waiting import eventually


def waits(seconds: float) -> Caller:
    """A caller who still waits for so long."""
    return Caller(lambda: seconds)


def test_first_come_is_first_served() -> None:
    slots = Slots(1, "tests", 60.0)
    slots.take(Caller())
    served: queue.SimpleQueue[int] = queue.SimpleQueue()

    def wait(number: int) -> None:
        with slots.held(Caller()):
            served.put(number)

    with ThreadPoolExecutor(3) as pool:
        for number in range(3):
            pool.submit(wait, number)
            eventually(lambda number=number: slots.queued == number + 1)  # type: ignore[misc]
        assert served.empty()
        slots.give_back()
    assert [served.get() for _ in range(3)] == [0, 1, 2]
    assert (slots.busy, slots.queued) == (0, 0)


def test_more_slots_serve_those_who_wait_and_fewer_nobody_until_enough_are_back() -> None:
    slots = Slots(1, "tests", 60.0)
    with ThreadPoolExecutor(2) as pool:
        pool.map(slots.take, [Caller(), Caller()])
        eventually(lambda: slots.queued == 1)
        slots.resize(2)
    slots.resize(1)
    slots.give_back()
    with pytest.raises(SlotsTakenError), slots.held_at_once():
        pass


def test_one_who_leaves_the_queue_is_gone_at_once() -> None:
    slots, caller = Slots(1, "tests", math.inf, HandClock()), Caller()
    slots.take(Caller())
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(slots.take, caller)
        eventually(lambda: slots.queued == 1)
        caller.leave()
        with pytest.raises(CallerLeft):
            waiting.result(60)
    assert slots.queued == 0
    slots.give_back()
    assert slots.busy == 0
    with pytest.raises(CallerLeft):
        slots.take(caller)


@pytest.mark.parametrize(("deadline_s", "left_s"), [(5.0, math.inf), (math.inf, 5.0)])
def test_nobody_waits_beyond_the_deadline_nor_its_own(deadline_s: float, left_s: float) -> None:
    clock = HandClock()
    slots = Slots(1, "decodes", deadline_s, clock)
    slots.take(Caller())
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(slots.take, waits(left_s))
        clock.until_somebody_waits()
        clock.advance(4.9)
        assert slots.queued == 1
        clock.advance(0.2)
        with pytest.raises(SlotsTakenError) as error:
            waiting.result(60)
    assert error.value.subject == "concurrent decodes"
    assert slots.queued == 0


def test_who_would_wait_too_long_is_turned_away_before_anything_is_spent() -> None:
    slots = Slots(2, "decodes", 60.0)
    slots.took(1.0)
    slots.check(waits(1.2))
    with pytest.raises(OverloadedError) as alone:
        slots.check(waits(0.5))
    assert alone.value.retry_s is None  # no use to come back with that deadline
    slots.take(Caller())
    slots.check(waits(1.2))  # one of both slots is free
    slots.take(Caller())
    assert slots.expected_wait_s() == 0.5
    with pytest.raises(OverloadedError) as queued:
        slots.check(waits(1.2))
    assert queued.value.retry_s == 0.5  # a slot is free by then
    slots.check(waits(1.7))
    with pytest.raises(SlotsTakenError) as taken:
        slots.take(waits(0.0))
    assert taken.value.retry_s == 0.5


def test_a_slot_is_not_held_by_one_for_whom_it_comes_too_late() -> None:
    slots, left = Slots(1, "decodes", 60.0), [2.0]
    slots.took(1.0)
    slots.take(Caller())
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(slots.take, Caller(lambda: left[0]))
        eventually(lambda: slots.queued == 1)
        left[0] = 1.05  # less than the work takes with its margin
        slots.give_back()
        with pytest.raises(OverloadedError) as error:
            waiting.result(60)
    assert error.value.retry_s == 1.0
    assert slots.busy == 0


def test_slow_calls_are_forgotten_and_a_few_turn_nobody_away() -> None:
    # Where all are refused, nothing else would show that calls are fast again.
    clock = HandClock()
    slots = Slots(1, "decodes", 60.0, clock)
    for _ in range(30):
        slots.took(5.0)
    assert slots.usual_s == 5.0
    with pytest.raises(OverloadedError):
        slots.check(waits(3.0))
    clock.advance(FORGET_S + 0.1)
    assert slots.usual_s == 0.0
    slots.check(waits(3.0))
    slots.took(0.1)
    with pytest.raises(OverloadedError):
        slots.check(waits(0.1))

    # A page in twenty that is searched for, say, does not shut out callers whose pages are not.
    slots = Slots(1, "decodes", 60.0)
    for _ in range(19):
        slots.took(0.1)
    slots.took(5.0)
    slots.check(waits(0.12))
    slots.took(5.0)
    with pytest.raises(OverloadedError):
        slots.check(waits(0.12))


def test_steps_that_may_be_left_out_are_not_waited_for() -> None:
    slots = Slots(1, "decodes", 60.0)
    slots.took(1.0, skipped_s=2.0)
    assert (slots.usual_s, slots.needed_s) == (1.0, pytest.approx(3.3))
    with pytest.raises(OverloadedError, match=r"3\.30"):
        slots.check(waits(2.0))
    with pytest.raises(OverloadedError, match=r"2\.30"):
        slots.take(waits(2.0), optional_s=1.0)
    assert slots.busy == 0
    with slots.held(waits(2.0), optional_s=2.0):
        assert slots.expected_wait_s() == 1.0


def test_a_slot_that_is_taken_at_once_is_waited_for_by_nobody() -> None:
    slots = Slots(2, "uploads", 60.0)
    with slots.held_at_once(), slots.held_at_once():
        with pytest.raises(SlotsTakenError) as error, slots.held_at_once():
            pass
        assert (error.value.subject, error.value.retry_s, slots.busy) == ("uploads", 1.0, 2)
    assert slots.busy == 0


def test_many_sessions_are_bounded() -> None:
    made = list[object]()
    sessions = Sessions(lambda _: made.append(object()) or made[-1], most=3)  # type: ignore[arg-type,return-value,func-returns-value]
    first = sessions.of("0")
    for name in "1203":
        sessions.of(name)
    assert sessions.of("0") is first
    sessions.of("1")
    assert len(made) == 5


def test_names_of_different_callers_are_different() -> None:
    assert own_name("7/job", "line") != own_name("job", "line/7")
    assert own_name("job", "") == "job"
    assert named_session("job", "line") == f"session {own_name('job', 'line')}"


def test_a_decode_that_does_not_end_is_trouble() -> None:
    now = 0.0
    heart = Heart(10.0, lambda: now)
    assert heart.trouble() == ""
    with heart.at_work():
        now = 9.0
        assert heart.trouble() == ""
        with heart.at_work():
            now = 12.0
            assert "12 s" in heart.trouble()
            heart.waits()
            assert heart.trouble() == ""
    assert heart.trouble() == ""
