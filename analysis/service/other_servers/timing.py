"""Times calls: one after the other in turns, and of some callers at once."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from analysis.service.other_servers.calls import CALL_S, WORK_S, Call
from lightpage.progress import track

T = TypeVar("T")

WARM = 5
"""Calls of each that are not counted: buffers and connections are made in them."""
CALLERS = 4


def in_turns(
    calls: Mapping[str, Callable[[], T]], rounds: int, what: str, rng: np.random.Generator, warm: int = WARM
) -> dict[str, list[T]]:
    """Call in turns, and return the calls' results by name, one a round; each round has an order of its own, by chance.

    Args:
        calls: calls by name.
        rounds: rounds that count.
        what: is timed, for the progress.
        rng: generator of the orders.
        warm: rounds before these.
    """
    told: dict[str, list[T]] = {name: [] for name in calls}
    for number in track(range(warm + rounds), what, total=warm + rounds):
        for name in rng.permutation(list(calls)).tolist():
            value = calls[name]()
            if number >= warm:
                told[name].append(value)
    return told


@dataclass(frozen=True)
class Timed:
    """A call that was timed.

    Attributes:
        seconds: seconds of the call.
        work_s: seconds of these for the service's checks and decision; zero of other servers.
    """

    seconds: float
    work_s: float = 0.0


def timed(call: Call) -> Timed:
    """Call once."""
    begun = time.perf_counter()
    answer = call()
    return Timed(time.perf_counter() - begun, float(answer.get(WORK_S, 0.0)))


def rate(connect: Callable[[], AbstractContextManager[Call]], calls_each: int) -> float:
    """Answers a second to `CALLERS` callers at once; each has its own connection, and calls once before the clock runs.

    Args:
        connect: a caller.
        calls_each: calls of each caller.

    Raises:
        Exception: what a call has raised; the others have ended then.
    """
    begun: list[float] = []
    ready = threading.Barrier(CALLERS, lambda: begun.append(time.perf_counter()), CALL_S)

    def caller() -> float:
        try:
            with connect() as call:
                call()
                ready.wait()
                for _ in range(calls_each):
                    call()
                return time.perf_counter()
        except BaseException:
            ready.abort()
            raise

    with ThreadPoolExecutor(CALLERS) as pool:
        futures = [pool.submit(caller) for _ in range(CALLERS)]
    errors = [error for future in futures if (error := future.exception()) is not None]
    for error in sorted(errors, key=lambda error: isinstance(error, threading.BrokenBarrierError)):
        raise error  # what broke the barrier, not that it is broken
    ended = [future.result() for future in futures]
    return CALLERS * calls_each / (max(ended) - begun[0])
