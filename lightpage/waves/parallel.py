"""Calculations on several threads beside each other."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

from lightpage.systems import cores

ITEM = TypeVar("ITEM")
RESULT = TypeVar("RESULT")


_THREAD = threading.local()
"""Whether a thread is one of several that compute beside each other."""


def threads_beside() -> int:
    """Return the number of threads that may compute beside each other.

    It is the first number of OMP_NUM_THREADS, or one a core, where OPENBLAS_NUM_THREADS keeps products of matrices to
    one thread; 1 where they may take several by themselves.
    """
    chosen = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        return 1
    return max(1, int(chosen)) if chosen.isdigit() else cores()


def in_parallel(function: Callable[[ITEM], RESULT], items: Sequence[ITEM]) -> Iterator[RESULT]:
    """Yield a function's results, in the order of the items; the first error ends the rest.

    A calculation that is one of several already keeps to its thread.

    Args:
        function: function of an item, which lets other threads compute, as numpy's products do.
        items: its arguments.
    """
    count = 1 if vars(_THREAD) else min(threads_beside(), len(items))
    if count < 2:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(count, initializer=partial(setattr, _THREAD, "beside", True)) as pool:
        yield from pool.map(function, items)
