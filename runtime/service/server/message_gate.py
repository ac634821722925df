"""Gate of incoming messages: the size of each, and the number on their way at once."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Collection, Mapping
from contextlib import aclosing, asynccontextmanager
from functools import partial
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from lightpage.errors import LightpageError, LimitError, MalformedError, OverloadedError, StalledError
from lightpage.runtime.client.wire.status import status_of, told, trailers
from lightpage.runtime.service.limits import Limits

_LEAST_PLACES = 8
_STREAM_PLACES = 64
"""Senders of frames that may pause at once, whatever a message may weigh."""
_SPARE_PLACES = 16
"""Beyond the calls at once: for those that are turned away, and those that are no load."""
_RETRY_S = 1.0


class MessageGate(grpc.aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in its types alone
    """Bounds the memory of messages that are on their way, and how long a sender may pause.

    gRPC has one limit of a message's size for all methods, and takes any number of messages at once. Behind the gate, a
    message is read only once a service has a place for it; a service has as many places as messages of the largest size
    fit into `Limits.receive_bytes`. Each service has its own: who stalls in one keeps nobody from another. Its streams
    have further ones, since their senders may pause: they keep no short call waiting. A message beyond the limit of its
    method is dropped as soon as it has come.

    Args:
        limits: limits of the service.
        large: by the full name of a method that takes larger messages than others, e.g. ``"/package.Service/Method"``,
            the bytes of its largest one. It may take as long as a frame pair.
        streams: full names of the methods whose callers send many messages.
    """

    def __init__(self, limits: Limits, large: Mapping[str, int], streams: Collection[str] = ()) -> None:
        self._streams = frozenset(streams)
        self.limits, self.large = limits, large
        self.largest = max(limits.message_bytes, *large.values()) if large else limits.message_bytes
        """Bytes of the largest message of any method."""
        fitting = max(_LEAST_PLACES, limits.receive_bytes // self.largest)
        most = limits.concurrent_calls + _SPARE_PLACES
        self.places = min(most, fitting)
        """Of each service."""
        self.stream_places = min(most, max(fitting, _STREAM_PLACES))
        """Of the streams of each."""
        self._places: dict[tuple[str, bool], asyncio.Semaphore] = {}

    def _places_of(self, method: str) -> asyncio.Semaphore:
        """Return the places that a method shares with others."""
        is_stream = method in self._streams
        kind = method.strip("/").partition("/")[0], is_stream
        if kind not in self._places:
            self._places[kind] = asyncio.Semaphore(self.stream_places if is_stream else self.places)
        return self._places[kind]

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[Any]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> Any:
        """The handler of a method, with messages that come through the gate."""
        handler, method = await continuation(handler_call_details), handler_call_details.method
        if handler is None:
            return None
        serve = (
            handler.unary_unary or handler.unary_stream or handler.stream_unary or handler.stream_stream
        )  # the others are None
        make: Any = grpc.stream_unary_rpc_method_handler
        if handler.response_streaming:
            make = grpc.stream_stream_rpc_method_handler
        through: Any = _generated if inspect.isasyncgenfunction(serve) else _answered
        read = partial(_Messages, self, self._places_of(method), method, handler.request_deserializer)
        return make(partial(through, serve, read, handler.request_streaming), None, handler.response_serializer)


class _Messages:
    """The messages of one call.

    Args:
        gate: gate that they come through.
        places: places of the call's service.
        method: full name of it.
        parse: parser of a message, None for the bytes themselves.
        data: bytes from the library.
    """

    def __init__(
        self,
        gate: MessageGate,
        places: asyncio.Semaphore,
        method: str,
        parse: Callable[[bytes], Any] | None,
        data: AsyncIterator[bytes],
    ) -> None:
        limits = gate.limits
        self._gate, self._places, self._parse, self._data = gate, places, parse, data
        self._name = method.rpartition("/")[2]
        self._largest = gate.large.get(method, limits.message_bytes)
        self._longest_s = limits.receive_s if method in gate.large else limits.stall_s

    def __aiter__(self) -> _Messages:
        return self

    async def __anext__(self) -> Any:
        async with self._place():
            try:
                async with asyncio.timeout(self._longest_s):
                    message = await anext(self._data)
            except TimeoutError:
                expected = f"the next message within {self._longest_s:g} s"
                raise StalledError(f"stream of {self._name}", "nothing", expected) from None
        if (size := len(message)) > self._largest:
            del message
            await self.aclose()
            raise LimitError(f"message of {self._name}", f"{size} bytes", f"at most {self._largest}")
        if self._parse is None:
            return message
        try:
            return self._parse(message)
        except DecodeError as error:
            await self.aclose()
            raise MalformedError(f"message of {self._name}", str(error), "one that can be parsed") from None

    async def aclose(self) -> None:
        """Read no more. Until then, the library keeps the message that it gave out last."""
        generator: Any = aiter(self._data)
        await generator.aclose()

    @asynccontextmanager
    async def _place(self) -> AsyncIterator[None]:
        try:
            async with asyncio.timeout(self._gate.limits.stall_s):
                await self._places.acquire()
        except TimeoutError:
            got, expected = f"{self._gate.places} on their way", f"at most {self._gate.places}; try again later"
            raise OverloadedError("messages", got, expected, retry_s=_RETRY_S) from None
        try:
            yield
        finally:
            self._places.release()


async def _answered(
    serve: Callable[..., Awaitable[Any]], read: Callable[..., _Messages], many: bool, data: Any, context: Any
) -> Any:
    async with _status(context):
        messages = read(data)
        return await serve(messages if many else await _one(messages), context)


async def _generated(
    serve: Callable[..., AsyncGenerator[Any, None]], read: Callable[..., _Messages], many: bool, data: Any, context: Any
) -> AsyncIterator[Any]:
    async with _status(context):
        messages = read(data)
        async with aclosing(serve(messages if many else await _one(messages), context)) as replies:
            async for reply in replies:
                yield reply


async def _one(messages: _Messages) -> Any:
    async for message in messages:
        await messages.aclose()
        return message
    raise MalformedError("message", "none", "one")


@asynccontextmanager
async def _status(context: Any) -> AsyncIterator[None]:
    """End a call of a service that does not look after its errors."""
    try:
        yield
    except LightpageError as error:
        await context.abort(status_of(error), told(error), trailers(error))
