"""Memory of a pair goes to a later one, and never while somebody looks at it."""

from __future__ import annotations

import numpy as np

from runtime.service.receiver import PairReceiver, ReceiveBudget

SHAPE = (4, 5)


def received(budget: ReceiveBudget, value: int) -> PairReceiver:
    receiver = PairReceiver(SHAPE, "uint8", 1000, budget)
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
    small = PairReceiver((2, 2), "uint16", 1000, budget)
    small.add(bytes(16))
    assert small.pair().in_phase.shape == (2, 2)
    second.close()
    assert budget.used == 16
