"""Reading a recording while its pages are decoded: disk, unpacking and transfer beside the arithmetic."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def read_ahead(read: Callable[[int], T], pages: Iterable[int]) -> Generator[tuple[int, Future[T]], None, None]:
    """Every page's number and what is read of it, in order; the next page is read while the caller works on one.

    One page is held beside the caller's, whatever a page weighs. A recording has one lock for all that is read of it,
    so what the caller reads of it meanwhile waits.

    Args:
        read: what is wanted of a page; `result()` raises what it raises.
        pages: their numbers.
    """
    reader = ThreadPoolExecutor(1, "read-ahead")
    ahead: deque[tuple[int, Future[T]]] = deque()
    try:
        for page in pages:
            ahead.append((page, reader.submit(read, page)))
            if len(ahead) > 1:
                yield ahead.popleft()
        yield from ahead
    finally:
        reader.shutdown(cancel_futures=True)
