"""The Python client has all that the contract offers to one who decodes and reads."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lightpage.errors import FrameError, InvalidInputError
from lightpage.recording.frame_pair import FramePair
from runtime.acquisition.source import Shot
from runtime.errors import LostShotError, Reason, RequestIdError
from runtime.wire.pages import RemotePage
from tests.runtime.rpc.stage import Running, Start, a_page


def test_what_the_caller_says_of_a_pair_comes_back(service: Running) -> None:
    page = service.client.decode(a_page()[1], frame_id=2**60, captured_s=1.5, correlation_id="mine")
    assert (page.frame_id, page.captured_s, page.correlation_id) == (2**60, 1.5, "mine")


def test_a_page_that_is_asked_for_again(start: Start) -> None:
    client = start().client
    first = client.read_page(request_id="a", correlation_id="mine")
    again = client.read_page(request_id="a", correlation_id="mine")
    assert (first.page, first.replayed, first.correlation_id) == (0, False, "mine")
    assert (again.page, again.replayed) == (0, True)
    with pytest.raises(RequestIdError):
        client.read_page(3, request_id="a")


def test_many_pairs_in_one_call(service: Running) -> None:
    symbols, pair = a_page()
    dark = FramePair(np.zeros_like(pair.in_phase), pair.quadrature)
    found = list(service.client.decode_pages([pair, dark, pair], correlation_id="mine"))
    assert isinstance(found[1], FrameError)
    for number in (0, 2):
        page = found[number]
        assert isinstance(page, RemotePage)
        assert (page.frame_id, page.correlation_id) == (number, "mine")
        assert (page.symbols == symbols).all()


def test_pairs_that_fail_on_the_callers_side_end_the_call_with_their_error(service: Running) -> None:
    def pairs() -> Iterator[FramePair]:
        yield a_page()[1]
        raise KeyError("mine")

    with pytest.raises(KeyError):
        list(service.client.decode_pages(pairs()))
    good = a_page()[1]
    for bad in (
        FramePair(np.zeros((2, 2)), np.zeros((2, 2))),  # type: ignore[arg-type]
        replace(good, quadrature=good.quadrature[1:]),
        replace(good, quadrature=good.quadrature.astype(np.uint16)),
        replace(good, in_phase=good.in_phase[0]),
    ):
        with pytest.raises(FrameError):
            list(service.client.decode_pages([bad]))


def test_many_pages_of_the_source_in_one_call(start: Start) -> None:
    service = start()

    def lost(shot: Shot) -> Shot:
        if shot.page_index == 5:
            raise LostShotError("page 5", "no frame", "one", Reason.MISSING_FRAME)
        return shot

    service.reading(lost)
    first, gone, last = service.client.read_pages([2, 5, 1], want_written=True)
    assert isinstance(gone, LostShotError)
    assert gone.reason is Reason.MISSING_FRAME
    for page, number in ((first, 2), (last, 1)):
        assert isinstance(page, RemotePage)
        assert (page.page, page.written is None) == (number, False)
    assert [one.page for one in service.client.read_pages(count=2) if isinstance(one, RemotePage)] == [0, 1]


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda client: client.read_page(-1), "page"),
        (lambda client: client.read_page(10**12), "page"),
        (lambda client: client.decode(a_page()[1], -1), "levels"),
        (lambda client: client.decode(a_page()[1], frame_id=2**64), "frame_id"),
        (lambda client: client.activate_model("\ud800"), "version"),
        (lambda client: client.start_recalibration(count=5 * 10**9), "count"),
        (lambda client: client.recalibrate(pages=[-1]), "pages"),
        (lambda client: client.upload_pages(np.zeros((1, 2, 2), np.uint8), 10**10), "levels"),
        (lambda client: list(client.read_data(0, 2**40)), "pages"),
    ],
)
def test_what_no_message_can_hold_is_named(call: Any, field: str, service: Running) -> None:
    with pytest.raises(InvalidInputError) as error:
        call(service.client)
    assert error.value.subject == field
