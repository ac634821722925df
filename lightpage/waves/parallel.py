"""Calculations on several threads beside each other."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from lightpage.systems import cores

ITEM = TypeVar("ITEM")
RESULT = TypeVar("RESULT")


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

    Args:
        function: function of an item, which lets other threads compute, as numpy's products do.
        items: its arguments.
    """
    count = min(threads_beside(), len(items))
    if count < 2:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(count) as pool:
        yield from pool.map(function, items)
