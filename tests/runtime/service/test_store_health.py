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
    assert health.is_well()
    now[0] = 5.1
    assert not health.is_well()
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
