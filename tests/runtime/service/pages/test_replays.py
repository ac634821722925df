"""What callers send again or leave behind is bounded: answers by request id, and the memory of pairs."""

import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from unittest.mock import Mock

import grpc
import numpy as np
import pytest

from lightpage.errors import (
    CallerLeft,
    LightpageError,
    LostShotError,
    Reason,
    RequestIdError,
    SlotsTakenError,
    StorageError,
    UnconfirmedPageError,
)
from lightpage.runtime.client.wire.status import status_of
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.frames.frames import PairReceiver, ReceiveBudget
from lightpage.runtime.service.pages.replays import Replays
from tests.clock import HandClock


@pytest.mark.parametrize(
    "failure",
    [
        LostShotError("page 1", "no frame", "one", Reason.MISSING_FRAME),
        UnconfirmedPageError("pilots", "none", "some", Reason.PILOTS_DISAGREE, recalibration_due=True),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_failure_that_is_kept_comes_again_as_it_was_and_is_counted(failure: LightpageError) -> None:
    replays, done = Replays(600, 1 << 20), list[bytes]()

    def work() -> bytes:
        done.append(bytes(1 << 16))
        raise failure

    told = list[LightpageError]()
    for _ in range(3):
        with pytest.raises(type(failure)) as caught:
            replays.once("a", b"request", Caller(), work)
        told.append(caught.value)
    assert len(done) == 1
    assert told[1] is not told[2]
    assert len({str(error) for error in told}) == 1
    assert all(vars(error).get("reason") == vars(failure).get("reason") for error in told)
    assert told[2].__context__ is None
    assert 100 < replays.held_bytes <= 2048


def test_an_error_that_nobody_foresaw_is_kept_by_its_class_alone() -> None:
    replays = Replays(600, 1 << 20)
    for kind in (ZeroDivisionError, LightpageError):  # whoever asks again
        with pytest.raises(kind) as caught:
            replays.once("a", b"", Caller(), lambda: bytes(1 // 0))
    assert "ZeroDivisionError" in str(caught.value)
    assert status_of(caught.value) is grpc.StatusCode.INTERNAL


@pytest.mark.parametrize(
    "failure", [StorageError("recording", "EIO", "data"), SlotsTakenError("decodes", "all", "one")]
)
def test_what_failed_before_a_shot_is_tried_again(failure: LightpageError) -> None:
    replays, tries = Replays(600, 1 << 20), iter([failure, None])

    def work() -> bytes:
        if (error := next(tries)) is not None:
            raise error
        return b"page"

    with pytest.raises(type(failure)):
        replays.once("a", b"", Caller(), work)
    assert replays.held_bytes == 0
    assert replays.once("a", b"", Caller(), work) == (b"page", False)


def test_the_oldest_go_where_the_budget_is_full() -> None:
    replays = Replays(600, 20_000)
    lost = Mock(side_effect=LostShotError("page 1", "no frame", "one", Reason.MISSING_FRAME))
    for number in range(200):
        with pytest.raises(LostShotError):
            replays.once(str(number), bytes(number), Caller(), lost)
    assert 10_000 < replays.held_bytes <= 22_000
    assert replays.once("0", b"", Caller(), lambda: b"anew") == (b"anew", False)
    with pytest.raises(LostShotError):
        replays.once("199", bytes(199), Caller(), bytes)


def test_answers_go_when_their_time_is_up() -> None:
    clock = HandClock()
    replays = Replays(600, 1 << 20, clock)
    assert replays.once("a", b"", Caller(), lambda: b"1") == (b"1", False)
    clock.advance(600)
    assert replays.once("a", b"", Caller(), lambda: b"2") == (b"1", True)
    clock.advance(0.1)
    assert replays.once("a", b"", Caller(), lambda: b"2") == (b"2", False)


class Asked:
    """An answer that takes as long as it is let, and who waits for it."""

    def __init__(self) -> None:
        self.clock, self.go, self.begun = HandClock(), threading.Event(), threading.Event()
        self.replays = Replays(600, 1 << 20, self.clock)
        self.pool = ThreadPoolExecutor(2)
        self.first = self.ask(Caller())
        assert self.begun.wait(60)

    def ask(self, caller: Caller) -> Future[tuple[bytes, bool]]:
        return self.pool.submit(self.replays.once, "a", b"request", caller, self._work)

    def _work(self) -> bytes:
        self.begun.set()
        self.go.wait()
        return b"page"


@pytest.fixture
def asked() -> Iterator[Asked]:
    made = Asked()
    yield made
    made.go.set()
    made.pool.shutdown()


def test_who_asks_meanwhile_waits_for_the_first_ones_answer(asked: Asked) -> None:
    second = asked.ask(Caller())
    asked.clock.until_somebody_waits()
    asked.go.set()
    assert (asked.first.result(60), second.result(60)) == ((b"page", False), (b"page", True))


def test_who_waits_goes_when_its_time_is_up_or_it_leaves(asked: Asked) -> None:
    late = asked.ask(Caller(lambda: 2.0))
    asked.clock.until_somebody_waits()
    asked.clock.advance(2.0)
    with pytest.raises(SlotsTakenError):
        late.result(60)
    leaving = Caller()
    left = asked.ask(leaving)
    asked.clock.until_somebody_waits()
    leaving.leave()
    with pytest.raises(CallerLeft):
        left.result(60)
    with pytest.raises(RequestIdError):
        asked.replays.once("a", b"another request", Caller(), bytes)


SHAPE = (4, 5)


def received(budget: ReceiveBudget, value: int) -> PairReceiver:
    receiver = PairReceiver(SHAPE, "uint8", budget)
    receiver.add(bytes([value]) * receiver.size)
    return receiver


def address(receiver: PairReceiver) -> int:
    return receiver.pair().in_phase.ctypes.data


def test_a_pair_lies_where_one_lay_before_that_nobody_looks_at() -> None:
    budget = ReceiveBudget(1000)
    first = received(budget, 1)
    before = address(first)
    first.close()
    first.close()  # is nothing new
    held = np.empty(40, np.uint8)  # would have got it from the system otherwise
    second = received(budget, 2)
    assert address(second) == before
    assert (second.pair().in_phase == 2).all()
    assert (budget.used, budget.taken) == (held.size, 2 * held.size)


def test_frames_that_are_still_held_stay_as_they_are() -> None:
    budget = ReceiveBudget(1000)
    first = received(budget, 1)
    frame = first.pair().quadrature[1:, ::2]  # a view of a view
    first.close()
    second = received(budget, 2)
    assert (frame == 1).all()
    assert (second.pair().in_phase == 2).all()
    assert address(second) != frame.ctypes.data


def test_another_size_takes_memory_of_its_own_and_one_pair_at_a_time_is_kept() -> None:
    budget = ReceiveBudget(1000)
    first, second = received(budget, 1), received(budget, 2)
    assert address(first) != address(second)
    first.close()
    small = PairReceiver((2, 2), "uint16", budget)
    small.add(bytes(16))
    assert small.pair().in_phase.shape == (2, 2)
    second.close()
    assert budget.used == 16
