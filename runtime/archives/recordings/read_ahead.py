"""Reading a recording while its pages are decoded: disk, unpacking and transfer beside the arithmetic."""

from __future__ import annotations

from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def read_ahead(read: Callable[[int], T], pages: int) -> Generator[tuple[int, Future[T]], None, None]:
    """Every page's number and what is read of it, in order; the next page is read while the caller works on one.

    One page is held beside the caller's, whatever a page weighs. A recording has one lock for all that is read of it,
    so what the caller reads of it meanwhile waits.

    Args:
        read: what is wanted of a page; `result()` raises what it raises.
        pages: how many there are.
    """
    reader = ThreadPoolExecutor(1, "read-ahead")
    try:
        following = reader.submit(read, 0) if pages else None
        for index in range(pages):
            current = following
            assert current is not None
            following = reader.submit(read, index + 1) if index + 1 < pages else None
            yield index, current
    finally:
        reader.shutdown(cancel_futures=True)
