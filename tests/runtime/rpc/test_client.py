"""The Python client has all that the contract offers to one who decodes and reads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lightpage.errors import FrameError, InvalidInputError, LimitError
from lightpage.recording.frame_pair import FramePair
from runtime.acquisition.source import Shot
from runtime.client.client import LightpageClient
from runtime.errors import LostShotError, Reason, RequestIdError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.rpc.server import LightpageServer
from runtime.service.limits import Limits
from runtime.wire.channel import open_channel
from runtime.wire.pages import RemotePage
from tests.runtime.rpc.stage import Start, a_page
from tests.runtime.rpc.test_edge import Remembering, parts


def test_a_description_has_the_limits_and_the_default_levels(start: Start) -> None:
    told = start(Limits(replay_s=7.0, range_pages=9)).client.describe()
    assert told.default_levels == 16
    assert told.limits is not None
    assert (told.limits.replay_s, told.limits.range_pages) == (7.0, 9)


def test_what_the_caller_says_of_a_pair_comes_back(start: Start) -> None:
    symbols, pair = a_page()
    page = start().client.decode(pair, frame_id=2**60, captured_s=1.5, correlation_id="mine")
    assert (page.frame_id, page.captured_s, page.correlation_id) == (2**60, 1.5, "mine")
    assert page.levels == 16  # the default is the source's
    assert (page.symbols == symbols).all()
    assert (page.frames, page.replayed, page.recalibration_reasons) == ((), False, ())


def test_the_black_level_is_taken_off(start: Start) -> None:
    symbols, pair = a_page()
    frames = (pair.in_phase, pair.quadrature)
    raised = FramePair(*(np.minimum(frame.astype(int) + 6, 255).astype(np.uint8) for frame in frames))
    assert (start().client.decode(raised, 16, black_level=6).symbols == symbols).all()


def test_sessions_and_pages_without_one(start: Start) -> None:
    client, pair = start(tracker=Remembering).client, a_page()[1]
    assert [client.decode(pair, session="mine").piston_rad for _ in range(2)] == [1, 2]
    assert [client.decode(pair, stateless=True).piston_rad for _ in range(2)] == [1, 1]
    assert [client.read_page(1, session="mine").piston_rad, client.read_page(1).piston_rad] == [3, 1]
    assert client.decode(pair, session="x" * 1024).piston_rad == 1
    with pytest.raises(InvalidInputError, match="session: got 1025 characters, wanted at most 1024"):
        client.decode(pair, session="x" * 1025)


def test_clients_at_one_unix_socket_are_followed_apart(start: Start, tmp_path: Path) -> None:
    running, address, pair = start(tracker=Remembering), f"unix:{tmp_path}/s", a_page()[1]
    with (
        LightpageServer(running.plane, running.recalibrator, address),
        LightpageClient(address, timeout_s=20) as one,
        LightpageClient(address, timeout_s=20) as two,
    ):
        assert [one.decode(pair).piston_rad for _ in range(3)] == [1, 2, 3]
        assert [two.decode(pair).piston_rad for _ in range(2)] == [1, 2]
        assert [one.decode(pair).piston_rad, one.decode(pair, stateless=True).piston_rad] == [4, 1]
        assert [client.decode(pair, session="both").piston_rad for client in (one, two)] == [1, 2]
        pages = [page for page in two.decode_pages([pair]) if isinstance(page, RemotePage)]
        assert [page.piston_rad for page in pages] == [3]
        assert one.read_page().piston_rad == 1  # the device's own


def test_pages_at_a_unix_socket_that_name_no_session_are_decoded_each_as_the_first(
    start: Start, tmp_path: Path
) -> None:
    running, address, pair = start(tracker=Remembering), f"unix:{tmp_path}/s", a_page()[1]
    with LightpageServer(running.plane, running.recalibrator, address), open_channel(address) as channel:
        decode = running.stub(channel).DecodeFrames
        assert [decode(parts(pair), timeout=20).piston_rad for _ in range(2)] == [1, 1]
        named = pb.DecodeOptions(levels=16, session="mine")
        assert [decode(parts(pair, options=named), timeout=20).piston_rad for _ in range(2)] == [1, 2]


def test_a_page_that_is_asked_for_again(start: Start) -> None:
    client = start().client
    first = client.read_page(request_id="a", correlation_id="mine")
    again = client.read_page(request_id="a", correlation_id="mine")
    assert (first.page, first.replayed, first.correlation_id) == (0, False, "mine")
    assert (again.page, again.replayed) == (0, True)
    with pytest.raises(RequestIdError):
        client.read_page(3, request_id="a")


def test_many_pairs_in_one_call(start: Start) -> None:
    client, (symbols, pair) = start().client, a_page()
    swapped = FramePair(np.zeros_like(pair.in_phase), pair.quadrature)
    found = list(client.decode_pages([pair, swapped, pair], correlation_id="mine"))
    assert [type(one) for one in found] == [RemotePage, type(found[1]), RemotePage]
    assert isinstance(found[1], FrameError)
    for number in (0, 2):
        page = found[number]
        assert isinstance(page, RemotePage)
        assert (page.frame_id, page.correlation_id) == (number, "mine")
        assert (page.symbols == symbols).all()


def test_pairs_that_fail_on_the_callers_side_end_the_call_with_their_error(start: Start) -> None:
    def pairs() -> Iterator[FramePair]:
        yield a_page()[1]
        raise KeyError("mine")

    client = start().client
    with pytest.raises(KeyError, match="mine"):
        list(client.decode_pages(pairs()))
    with pytest.raises(FrameError, match="float64"):
        list(client.decode_pages([FramePair(np.zeros((2, 2)), np.zeros((2, 2)))]))  # type: ignore[arg-type]


def test_many_pages_of_the_source_in_one_call(start: Start) -> None:
    service = start(Limits(range_pages=9))
    client, whole = service.client, service.source.shot

    def shot(timeout_s: float = 1.0, page: int | None = None) -> Shot:
        if page == 5:
            raise LostShotError("page 5", "no frame", "one", Reason.MISSING_FRAME)
        return whole(timeout_s, page)

    service.source.shot = shot  # type: ignore[method-assign]
    first, lost, last = client.read_pages([2, 5, 1], want_written=True)
    assert isinstance(lost, LostShotError)
    assert lost.reason is Reason.MISSING_FRAME
    for page, number in ((first, 2), (last, 1)):
        assert isinstance(page, RemotePage)
        assert page.page == number
        assert page.written is not None
    assert [one.page for one in client.read_pages(count=2) if isinstance(one, RemotePage)] == [0, 1]
    with pytest.raises(LimitError, match="at most 9"):
        list(client.read_pages(count=10))


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
def test_what_no_message_can_hold_is_named(call: Any, field: str, start: Start) -> None:
    with pytest.raises(InvalidInputError) as error:
        call(start().client)
    assert error.value.subject == field
