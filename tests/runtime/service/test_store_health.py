"""The store's health beside a disk that hangs."""

import threading
import time
from collections.abc import Callable

from runtime.service.store_health import StoreHealth


def until(condition: Callable[[], bool]) -> None:
    """Wait for it, 10 s at most."""
    end = time.monotonic() + 10
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    assert condition()


def test_what_the_last_look_found() -> None:
    """It follows the store both ways."""
    troubles = ["", "the disk is full"]
    health = StoreHealth(lambda: troubles[0])
    assert health.is_well()
    troubles.reverse()
    until(lambda: not health.is_well())
    troubles.reverse()
    until(health.is_well)


def test_who_waits_hears_what_this_look_finds() -> None:
    """And not what the one before found, however long the disk takes."""
    slow = threading.Event()
    assert not StoreHealth(lambda: slow.wait(0.05) or "the disk is full").is_well(10)


def test_many_who_ask_share_one_look() -> None:
    """A disk that hangs costs one thread, however many ask."""
    answers, begun, together = threading.Event(), list[None](), threading.Barrier(8)

    def trouble() -> str:
        begun.append(None)
        answers.wait(30)
        return ""

    health = StoreHealth(trouble)

    def ask() -> None:
        together.wait(10)
        health.is_well()

    askers = [threading.Thread(target=ask) for _ in range(8)]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join(10)
    try:
        until(lambda: bool(begun))
        assert len(begun) == 1
    finally:
        answers.set()


def test_a_look_that_hangs() -> None:
    """Nobody waits for it; after its time the store is not well, and it is again when the disk answers."""
    now, answers = [0.0], threading.Event()

    def trouble() -> str:
        answers.wait(30)
        return ""

    health = StoreHealth(trouble, longest_s=5, clock=lambda: now[0])
    begun = time.monotonic()
    assert health.is_well()
    now[0] = 5.0
    assert health.is_well(0.01)
    assert not health.hangs
    now[0] = 5.1
    assert not health.is_well()
    assert not health.is_well(30)
    assert health.hangs
    assert time.monotonic() - begun < 10
    answers.set()
    until(health.is_well)


def test_the_look_does_not_hold_the_end_of_the_process() -> None:
    """Its thread is a daemon."""
    answers = threading.Event()
    health = StoreHealth(lambda: str(answers.wait(30)))
    health.is_well()
    (look,) = [thread for thread in threading.enumerate() if thread.name == "lightpage-store-look"]
    assert look.daemon
    answers.set()
    look.join(10)
