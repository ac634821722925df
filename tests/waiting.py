"""Waiting for what other threads and processes do: the one place where tests look at a real clock."""

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

LIMIT_S = 60.0
"""Far longer than anything takes on a machine that is busy with other things."""
_LOOK_S = 0.01


def eventually(what: Callable[[], T], limit_s: float = LIMIT_S) -> T:
    """Call a function until its result is true, and return that; fail if it is not within the limit."""
    until = time.monotonic() + limit_s
    while not (found := what()):
        assert time.monotonic() < until, f"still {found!r} after {limit_s} s"
        time.sleep(_LOOK_S)
    return found
