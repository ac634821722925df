"""Working ahead: pages are read while others are decoded, or several are decoded at a time."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from typing import TypeVar

T = TypeVar("T")
Key = TypeVar("Key")


def read_ahead(
    read: Callable[[Key], T], pages: Iterable[Key], ahead: int = 1, over: Callable[[Key], None] = lambda page: None
) -> Generator[tuple[Key, Future[T]], None, None]:
    """Every page and what is read of it, in order; the next ones are read while the caller works on one.

    So many are held beside the caller's, whatever a page weighs. HDF5 has one lock for all that is read by it:
    several threads are faster than one only with pages that lie in the file as they are.

    Args:
        read: what is wanted of a page; `result()` raises what it raises.
        pages: their numbers, or whatever names them.
        ahead: threads that read, each one page at a time.
        over: is told of each page that was begun, once it was read or is dropped.
    """
    reader = ThreadPoolExecutor(ahead, "read-ahead")
    begun: deque[tuple[Key, Future[T]]] = deque()
    try:
        for page in pages:
            begun.append((page, future := reader.submit(read, page)))
            future.add_done_callback(partial(_told, over, page))
            if len(begun) > ahead:
                yield begun.popleft()
        while begun:
            yield begun.popleft()
    except BaseException:  # the caller wants no more; those that were handed out are read to the end otherwise
        reader.shutdown(cancel_futures=True)
        raise
    reader.shutdown()


def beside(
    work: Callable[[Key], T], pages: Iterable[Key], threads: int, over: Callable[[Key], None] = lambda page: None
) -> Generator[tuple[Key, Callable[[], T]], None, None]:
    """Every page, in order, and what does its work: now, or, with several threads, that waits for what is done ahead.

    Args:
        work: what is done with a page.
        pages: their numbers, or whatever names them.
        threads: number of threads that work.
        over: is told of each page once its work is done or dropped; with one thread, when the next one is asked for.
    """
    if threads == 1:
        for page in pages:
            try:
                yield page, partial(work, page)
            finally:
                over(page)
        return
    with closing(read_ahead(work, pages, threads, over)) as ahead:
        for page, begun in ahead:
            yield page, begun.result


def _told(over: Callable[[Key], None], page: Key, _: Future[T]) -> None:
    over(page)
