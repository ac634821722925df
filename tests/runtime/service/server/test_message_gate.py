"""What is on its way to the server is bounded: the size of a message, their number, and a sender's pauses."""

import asyncio
from collections.abc import AsyncIterator, Coroutine
from types import SimpleNamespace
from typing import Any

import grpc
import pytest
from google.protobuf.message import DecodeError

from lightpage.errors import LightpageError, LimitError, MalformedError, OverloadedError, StalledError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.status import DETAIL_KEY, error_from, status_of
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.server.message_gate import MessageGate

LARGE, SMALL = "/one.Service/Large", "/one.Service/Small"


class Context:
    """Ends a call by raising what the caller would."""

    async def abort(self, code: grpc.StatusCode, text: str, trailers: Any) -> None:
        error = error_from(pb.ErrorDetail.FromString(dict(trailers)[DETAIL_KEY]))
        assert (code, f"{error.got}" in text) == (status_of(error), True)
        raise error


async def told(request: bytes, context: object) -> bytes:
    return request.upper()


async def handler_of(gate: MessageGate, method: str, handler: Any = None) -> Any:
    """What the server calls for a method, by default one that takes a message and answers it."""
    handler = handler or grpc.unary_unary_rpc_method_handler(told)

    async def found(_: object) -> Any:
        return handler

    return await gate.intercept_service(found, SimpleNamespace(method=method))  # type: ignore[arg-type]


async def messages(*sent: bytes, then: Coroutine[Any, Any, Any] | None = None) -> AsyncIterator[bytes]:
    for each in sent:
        yield each
    if then is not None:
        await then


async def answer(gate: MessageGate, data: AsyncIterator[bytes], method: str = SMALL) -> Any:
    handler = await handler_of(gate, method)
    return await handler.stream_unary(data, Context())


async def refusal(gate: MessageGate, data: AsyncIterator[bytes], method: str = SMALL) -> LightpageError:
    with pytest.raises(LightpageError) as error:
        await answer(gate, data, method)
    return error.value


NARROW = Limits.model_construct(message_bytes=4, receive_bytes=1, stall_s=0.05, receive_s=60, concurrent_calls=1)
"""With which there are eight places for messages, and twice as many for streams; narrower than rules allow."""


def test_there_are_places_for_what_fits_into_the_budget() -> None:
    assert MessageGate(Limits(), {}).places == 192 + 16  # as many as there are calls, and some
    full_size = MessageGate(Limits(), {LARGE: 80 << 20})
    assert (full_size.largest, full_size.places) == (80 << 20, 12)
    assert MessageGate(Limits(), {LARGE: 1 << 30}).places == 8
    assert MessageGate(Limits(), {LARGE: 10}).largest == 4 << 20
    assert (full_size.stream_places, MessageGate(Limits(), {}).stream_places) == (64, 192 + 16)


def test_each_method_has_its_limit() -> None:
    gate = MessageGate(Limits.model_construct(message_bytes=4), {LARGE: 10})

    async def all_of_it() -> None:
        assert await answer(gate, messages(b"abcd")) == b"ABCD"
        assert await answer(gate, messages(b"abcdefghij"), LARGE) == b"ABCDEFGHIJ"
        for method, sent in ((SMALL, b"abcde"), (LARGE, b"abcdefghijk")):
            data = messages(sent, b"never read")
            error = await refusal(gate, data, method)
            assert (type(error), error.got) == (LimitError, f"{len(sent)} bytes")
            assert await anext(data, None) is None  # closed: it keeps nothing

    asyncio.run(all_of_it())


def test_no_more_are_on_their_way_than_there_are_places() -> None:
    gate = MessageGate(NARROW, {LARGE: 10})

    async def all_of_it() -> None:
        more, begun = asyncio.Event(), list[int]()

        async def waiting(number: int) -> AsyncIterator[bytes]:
            begun.append(number)
            await more.wait()
            yield b"late"

        held = [asyncio.ensure_future(answer(gate, waiting(number), LARGE)) for number in range(gate.places)]
        while len(begun) < gate.places:
            await asyncio.sleep(0)
        error = await refusal(gate, waiting(99))
        assert (type(error), error.subject) == (OverloadedError, "messages")
        assert begun == list(range(8))  # the ninth was not read at all
        assert await answer(gate, messages(b"ab"), "/another.Service/Small") == b"AB"
        late = asyncio.ensure_future(answer(gate, messages(b"abc")))
        await asyncio.sleep(0)
        more.set()
        assert await asyncio.gather(*held, late) == [b"LATE"] * 8 + [b"ABC"]

    asyncio.run(all_of_it())


def test_a_sender_that_pauses_is_ended_and_gives_its_place_back() -> None:
    gate = MessageGate(NARROW, {LARGE: 10})

    async def all_of_it() -> None:
        for _ in range(gate.places + 1):
            error = await refusal(gate, messages(then=asyncio.Event().wait()))
            assert (type(error), error.subject) == (StalledError, "stream of Small")
        assert await answer(gate, messages(b"ab")) == b"AB"

        async def slow() -> AsyncIterator[bytes]:
            await asyncio.sleep(0.1)
            yield b"slow"

        assert await answer(gate, slow(), LARGE) == b"SLOW"  # a large one may take longer

    asyncio.run(all_of_it())


def test_senders_who_pause_keep_no_short_call_waiting() -> None:
    gate = MessageGate(NARROW, {LARGE: 10}, [LARGE])

    async def both() -> None:
        pauses = [messages(then=asyncio.Event().wait()) for _ in range(gate.stream_places)]
        pausing = [asyncio.ensure_future(answer(gate, each, LARGE)) for each in pauses]
        await asyncio.sleep(0)
        assert await answer(gate, messages(b"abcd")) == b"ABCD"
        assert type(await refusal(gate, messages(b"abcd"), LARGE)) is OverloadedError
        for each in pausing:
            each.cancel()
        await asyncio.gather(*pausing, return_exceptions=True)

    asyncio.run(both())


def test_a_service_of_the_library_gets_its_messages_parsed() -> None:
    gate = MessageGate(Limits(), {})

    def parse(data: bytes) -> str:
        if data == b"\xff":
            raise DecodeError("garbage")
        return data.decode()

    async def both(requests: AsyncIterator[str], context: object) -> AsyncIterator[str]:
        async for request in requests:
            yield request * 2

    async def all_of_it() -> None:
        made = grpc.stream_stream_rpc_method_handler(both, parse)
        handler = await handler_of(gate, "/one.Service/Both", made)
        assert [reply async for reply in handler.stream_stream(messages(b"a", b"b"), Context())] == ["aa", "bb"]
        with pytest.raises(MalformedError) as error:
            _ = [reply async for reply in handler.stream_stream(messages(b"a", b"\xff"), Context())]
        assert (error.value.subject, error.value.got) == ("message of Both", "garbage")
        assert type(await refusal(gate, messages())) is MalformedError

    asyncio.run(all_of_it())
