"""The store's health beside a disk that hangs."""

from __future__ import annotations

import threading

import pytest

from runtime.service.store_health import LONGEST_S, StoreHealth
from tests.clock import HandClock
from tests.waiting import eventually

WAIT_S = 2.0


class Disk:
    """A disk that may hang."""

    def __init__(self) -> None:
        self.trouble, self.looks = "", 0
        self.answers = threading.Event()
        self.answers.set()

    def __call__(self) -> str:
        self.looks += 1
        self.answers.wait()
        return self.trouble


@pytest.fixture
def disk() -> Disk:
    return Disk()


def test_who_waits_hears_what_this_look_finds(disk: Disk) -> None:
    health = StoreHealth(disk, clock=HandClock())
    for trouble in ("", "full", ""):
        disk.trouble = trouble
        assert health.is_well(WAIT_S) == (not trouble)
        assert not health.hangs
    assert disk.looks == 3


def test_a_look_that_hangs_is_waited_for_by_nobody_and_shared_by_all(disk: Disk) -> None:
    clock = HandClock()
    health = StoreHealth(disk, clock=clock)
    disk.answers.clear()
    assert [health.is_well() for _ in range(8)] == [True] * 8  # nothing is known yet
    clock.advance(LONGEST_S)
    assert health.is_well()
    assert not health.hangs
    clock.advance(0.1)
    assert health.hangs
    assert not health.is_well()
    assert not health.is_well(WAIT_S)  # no wait: nobody moves the clock
    assert disk.looks == 1
    (look,) = [thread for thread in threading.enumerate() if thread.name == "lightpage-store-look"]
    assert look.daemon  # it does not hold the end of the process
    disk.answers.set()
    eventually(lambda: not health.hangs)
    assert health.is_well(WAIT_S)
    assert disk.looks == 2


def test_a_look_that_breaks_is_followed_by_another(disk: Disk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda told: None)
    troubles = iter([1, 0, 1])
    health = StoreHealth(lambda: 1 // next(troubles), clock=HandClock())
    assert [health.is_well(WAIT_S) for _ in range(3)] == [False, False, False]
