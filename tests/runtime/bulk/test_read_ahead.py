"""What is read while the caller works: each page in its place, one ahead, its error with it."""

from __future__ import annotations

import threading

import pytest

from runtime.bulk.read_ahead import read_ahead
from tests.waiting import LIMIT_S


def test_the_next_page_is_read_while_the_caller_works_and_no_further() -> None:
    begun = [threading.Event() for _ in range(5)]

    def read(index: int) -> str:
        begun[index].set()
        return f"page {index}"

    for index, page in read_ahead(read, 5):
        assert page.result(LIMIT_S) == f"page {index}"
        if index < 4:
            assert begun[index + 1].wait(LIMIT_S)  # while this page is still in the caller's hands
        assert not any(event.is_set() for event in begun[index + 2 :])


def test_a_page_that_cannot_be_read_says_so_in_its_place() -> None:
    def read(index: int) -> int:
        return 6 // (index - 1)

    failures = [page.exception(LIMIT_S) for _, page in read_ahead(read, 3)]
    assert [type(failure) for failure in failures] == [type(None), ZeroDivisionError, type(None)]


def test_whoever_stops_early_waits_for_no_page_that_has_not_begun() -> None:
    read: list[int] = []
    first, go = threading.Event(), threading.Event()

    def slow(index: int) -> int:
        read.append(index)
        first.set()
        assert go.wait(LIMIT_S)
        return index

    pages = read_ahead(slow, 4)
    next(pages)
    assert first.wait(LIMIT_S)
    threading.Timer(0.05, go.set).start()
    pages.close()
    assert read == [0]


def test_no_pages_are_none() -> None:
    with pytest.raises(StopIteration):
        next(read_ahead(lambda index: index, 0))
