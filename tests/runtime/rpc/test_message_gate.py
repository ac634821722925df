"""What is on its way to the server is bounded: the size of a message, their number, and a sender's pauses."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Coroutine
from types import SimpleNamespace
from typing import Any

import grpc
import pytest

from runtime.rpc import message_gate
from runtime.rpc.message_gate import MessageGate
from runtime.service.limits import Limits

LARGE = "/one.Service/Large"


class Ended(Exception):
    """A call was ended with a status."""


class Context:
    async def abort(self, code: grpc.StatusCode, text: str, trailers: object) -> None:
        raise Ended(code, text)


async def told(request: bytes, context: object) -> bytes:
    return request.upper()


def handler_of(gate: MessageGate, method: str, handler: Any = None) -> Any:
    """What the server calls for a method, by default one that takes a message and answers it."""
    handler = handler or grpc.unary_unary_rpc_method_handler(told)

    async def found(_: object) -> Any:
        return handler

    return gate.intercept_service(found, SimpleNamespace(method=method))  # type: ignore[arg-type]


async def messages(*sent: bytes, then: Coroutine[Any, Any, Any] | None = None) -> AsyncIterator[bytes]:
    for each in sent:
        yield each
    if then is not None:
        await then


async def answer(gate: MessageGate, data: AsyncIterator[bytes], method: str = "/one.Service/Small") -> Any:
    handler = await handler_of(gate, method)
    return await handler.stream_unary(data, Context())


def test_there_are_places_for_what_fits_into_the_budget() -> None:
    assert MessageGate(Limits(), {}).places == 192 + 16  # as many as there are calls, and some
    full_size = MessageGate(Limits(), {LARGE: 80 << 20})
    assert (full_size.largest, full_size.places) == (80 << 20, 12)
    assert MessageGate(Limits(), {LARGE: 1 << 30}).places == 8
    assert MessageGate(Limits(), {LARGE: 10}).largest == 4 << 20
    assert (full_size.stream_places, MessageGate(Limits(), {}).stream_places) == (64, 192 + 16)


def test_each_method_has_its_limit() -> None:
    gate = MessageGate(Limits(message_bytes=4), {LARGE: 10})

    async def all_of_it() -> None:
        assert await answer(gate, messages(b"abcd")) == b"ABCD"
        assert await answer(gate, messages(b"abcdefghij"), LARGE) == b"ABCDEFGHIJ"
        for method, sent, most in (("/one.Service/Small", b"abcde", 4), (LARGE, b"abcdefghijk", 10)):
            data = messages(sent, b"never read")
            with pytest.raises(Ended, match=f"RESOURCE_EXHAUSTED.*got {len(sent)} bytes, wanted at most {most}"):
                await answer(gate, data, method)
            assert await anext(data, None) is None  # closed: it keeps nothing

    asyncio.run(all_of_it())


def test_no_more_are_on_their_way_than_there_are_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_gate, "_LEAST_PLACES", 2)
    gate = MessageGate(Limits(message_bytes=4, receive_bytes=1, pair_bytes=1, stall_s=0.2), {LARGE: 10})

    async def all_of_it() -> None:
        more, begun = asyncio.Event(), list[int]()

        async def waiting(number: int) -> AsyncIterator[bytes]:
            begun.append(number)
            await more.wait()
            yield b"late"

        held = [asyncio.ensure_future(answer(gate, waiting(number), LARGE)) for number in range(2)]
        while len(begun) < 2:
            await asyncio.sleep(0)
        with pytest.raises(Ended, match=r"RESOURCE_EXHAUSTED.*messages: got 2 on their way"):
            await answer(gate, waiting(2), "/one.Service/Small")
        assert begun == [0, 1]  # the third was not read at all
        assert await answer(gate, messages(b"ab"), "/another.Service/Small") == b"AB"
        late = asyncio.ensure_future(answer(gate, messages(b"abc")))
        await asyncio.sleep(0)
        more.set()
        assert await asyncio.gather(*held, late) == [b"LATE", b"LATE", b"ABC"]

    asyncio.run(all_of_it())


def test_a_sender_that_pauses_is_ended_and_gives_its_place_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_gate, "_LEAST_PLACES", 1)
    limits = Limits(message_bytes=4, receive_bytes=1, pair_bytes=1, stall_s=0.05, receive_s=20)
    gate = MessageGate(limits, {LARGE: 10})

    async def all_of_it() -> None:
        with pytest.raises(Ended, match=r"CANCELLED.*stream of Small: got nothing.*0\.05 s"):
            await answer(gate, messages(then=asyncio.sleep(20)))
        assert await answer(gate, messages(b"ab")) == b"AB"

        async def slow() -> AsyncIterator[bytes]:
            await asyncio.sleep(0.2)
            yield b"slow"

        assert await answer(gate, slow(), LARGE) == b"SLOW"  # a large one may take longer

    asyncio.run(all_of_it())


def test_a_service_of_the_library_gets_its_messages_parsed() -> None:
    gate = MessageGate(Limits(), {})

    def parse(data: bytes) -> str:
        if data == b"\xff":
            raise message_gate.DecodeError("garbage")
        return data.decode()

    async def both(requests: AsyncIterator[str], context: object) -> AsyncIterator[str]:
        async for request in requests:
            yield request * 2

    async def all_of_it() -> None:
        made = grpc.stream_stream_rpc_method_handler(both, parse)  # type: ignore[arg-type]
        handler = await handler_of(gate, "/one.Service/Both", made)
        assert [reply async for reply in handler.stream_stream(messages(b"a", b"b"), Context())] == ["aa", "bb"]
        with pytest.raises(Ended, match=r"INVALID_ARGUMENT.*message of Both: got garbage"):
            _ = [reply async for reply in handler.stream_stream(messages(b"a", b"\xff"), Context())]
        with pytest.raises(Ended, match=r"INVALID_ARGUMENT.*none"):
            await answer(gate, messages())

    asyncio.run(all_of_it())


def test_senders_who_pause_keep_no_short_call_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_gate, "_LEAST_PLACES", 1)
    monkeypatch.setattr(message_gate, "_STREAM_PLACES", 1)
    gate = MessageGate(Limits(message_bytes=4, receive_bytes=1, pair_bytes=1, stall_s=5.0), {LARGE: 10}, [LARGE])

    async def both() -> None:
        never = asyncio.Event()
        pausing = asyncio.ensure_future(answer(gate, messages(then=never.wait()), LARGE))
        await asyncio.sleep(0)
        assert await asyncio.wait_for(answer(gate, messages(b"abcd")), 1.0) == b"ABCD"
        pausing.cancel()

    asyncio.run(both())
