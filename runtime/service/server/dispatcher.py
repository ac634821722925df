"""Dispatch of a call from its first byte to its status: parse, count, hand over to the handler, end.

A handler is a method named as the RPC, of one of the classes in this package. It takes the request, or an asynchronous
iterator of requests, and the `Call`; it returns the reply, or is a generator of replies. A plain `def` runs in a thread
and may block; an `async def` runs on the server's loop and must not. Its mark says what else there is to know; see
`lightpage.runtime.service.rpc`.
"""

from __future__ import annotations

import asyncio
import inspect
import math
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Generator, Sequence
from concurrent.futures import Executor, Future
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import grpc
from google.protobuf.descriptor import ServiceDescriptor
from google.protobuf.message_factory import GetMessageClass

from lightpage.errors import CallerLeft, MalformedError, OverloadedError, StalledError, StoppingError, let_go
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import parsed_part
from lightpage.runtime.client.wire.status import reason_told, status_of, told, trailers
from lightpage.runtime.service.caller import LOCAL, STRANGER, Call, Caller, Identity
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.traces import MOST_PAGES, Traces
from lightpage.runtime.service.rpc import Rpc
from lightpage.runtime.service.server.call_log import log_end
from lightpage.runtime.service.server.certificates import identity_of
from lightpage.runtime.service.stages import CallTimes

SERVICE = pb.DESCRIPTOR.services_by_name["Lightpage"]

_EARLY_S = 0.05
"""A caller whose call ends so long before its deadline has run out of time too: its clock is its own."""

_GONE_S = 0.05
"""From the end of a stream to the word that its caller has gone, rather than closed it, at most."""


@dataclass(frozen=True)
class Served:
    """A service that is served.

    Attributes:
        descriptor: descriptor of the service.
        handlers: objects whose methods answer.
        prefix: prefix of its methods' names in metrics and logs.
    """

    descriptor: ServiceDescriptor
    handlers: Sequence[object]
    prefix: str = ""

    def handler(self, method: str) -> Callable[..., Any] | None:
        """Return what answers a method."""
        return next((found for one in self.handlers if (found := getattr(one, method, None))), None)


@dataclass(frozen=True)
class _Method:
    """An RPC.

    Attributes:
        service: full name of its service.
        name: name in metrics and logs.
        handler: answers it.
        served: how.
        many: whether its callers send many messages.
        serialise: a reply.
    """

    service: str
    name: str
    handler: Callable[..., Any]
    served: Rpc
    many: bool
    serialise: Callable[[Any], bytes]


class Dispatcher:
    """Hands calls to their handlers. Lives on one event loop.

    Args:
        services: services that are served.
        pool: threads for handlers that block, as many as there may be calls.
        limits: limits of the service.
        metrics: what is counted.
        traces: are told of every call, None for none.
        secured: whether callers have certificates; then one without has no role.
    """

    def __init__(
        self,
        services: Sequence[Served],
        pool: Executor,
        limits: Limits,
        metrics: ServiceMetrics,
        traces: Traces | None = None,
        secured: bool = False,
    ) -> None:
        self._secured = secured
        self._services, self._pool, self._limits = tuple(services), pool, limits
        self._metrics, self._traces = metrics, traces
        self._active: set[asyncio.Task[Any]] = set()
        self._watching: set[asyncio.Task[Any]] = set()
        self._told: set[asyncio.Task[Any]] = set()
        """Of both those that were told to end."""
        self._refuses = False

    def rpc_handlers(self) -> tuple[grpc.GenericRpcHandler[Any, Any], ...]:
        """All RPCs of the services that have a handler, for the server.

        Messages are parsed by the gate before them: the library answers those that it cannot parse with INTERNAL and a
        traceback, and keeps 20 kB of each. They come as streams, even where there is but one: the library would read it
        before anybody could refuse the call. They go as bytes, so that serialising them is a part of the call, and
        timed with it.
        """
        return tuple(map(self._rpc_handler, self._services))

    def _rpc_handler(self, service: Served) -> grpc.GenericRpcHandler[Any, Any]:
        methods = {}
        for method in service.descriptor.methods:
            if (handler := service.handler(method.name)) is None:
                continue
            make, serve = {
                False: (grpc.stream_unary_rpc_method_handler, self._unary),
                True: (grpc.stream_stream_rpc_method_handler, self._stream),
            }[method.server_streaming]
            name, message = f"{service.prefix}{method.name}", GetMessageClass(method.input_type)
            served: Rpc = handler.rpc  # type: ignore[attr-defined]
            parse = parsed_part if message is pb.DecodeFramesRequest else message.FromString
            serialise = GetMessageClass(method.output_type).SerializeToString
            rpc = _Method(service.descriptor.full_name, name, handler, served, method.client_streaming, serialise)
            methods[method.name] = make(partial(serve, rpc), None if served.reads_later else parse, None)
        return grpc.method_handlers_generic_handler(service.descriptor.full_name, methods)

    def refuse(self) -> None:
        """Take no more calls: the service stops."""
        self._refuses = True

    def end_watches(self) -> None:
        """End the calls that would not end by themselves."""
        self._end(self._watching)

    def end_all(self) -> None:
        """End all calls."""
        self._end(self._active | self._watching)

    async def ended_within(self, seconds: float) -> bool:
        """Wait for the calls in flight; whether all of them have ended in time."""
        if self._active:
            await asyncio.wait(self._active, timeout=seconds)
        return not self._active

    def _end(self, tasks: set[asyncio.Task[Any]]) -> None:
        self._told |= tasks
        for task in tasks:
            task.cancel()

    async def _unary(self, rpc: _Method, data: AsyncGenerator[Any, None], context: Any) -> bytes:
        async with self._call(rpc, context) as call:
            request = self._messages(rpc, data, call) if rpc.many else await self._one(rpc, data, call)
            if inspect.iscoroutinefunction(rpc.handler):
                return rpc.serialise(await rpc.handler(request, call))
            return rpc.serialise(await asyncio.wrap_future(self._pool.submit(rpc.handler, request, call)))

    async def _stream(self, rpc: _Method, data: AsyncGenerator[Any, None], context: Any) -> AsyncIterator[bytes]:
        async with self._call(rpc, context) as call:
            request = self._messages(rpc, data, call) if rpc.many else await self._one(rpc, data, call)
            if inspect.isasyncgenfunction(rpc.handler):
                replies: AsyncGenerator[Any, None] = rpc.handler(request, call)
            else:
                replies = self._stepped(rpc.handler(request, call), call)
            loop = asyncio.get_running_loop()
            end = loop.time() + self._limits.range_s if rpc.served.is_range else None
            reader = _Reader(replies, partial(self._no_load, asyncio.current_task()))
            try:
                while True:
                    async with asyncio.timeout_at(end):
                        reply = await anext(replies, None)
                    if reply is None:
                        break
                    waiting = loop.call_later(self._limits.reader_s, reader.stalls)
                    try:
                        yield rpc.serialise(reply)
                    finally:
                        waiting.cancel()
                    reader.check(rpc.name)
            except TimeoutError:
                raise _slow(rpc.name) from None
            finally:
                await reader.close()

    def _no_load(self, task: asyncio.Task[Any] | None) -> None:
        """Count the call of a task as one that only watches from here on."""
        if task is not None and task in self._active:
            self._active.discard(task)
            self._watching.add(task)

    async def _stepped(self, replies: Generator[Any, None, None], call: Call) -> AsyncGenerator[Any, None]:
        """The replies of a generator that blocks, each made in a thread."""
        end = object()
        step: Future[Any] | None = None
        try:
            while True:
                step = self._pool.submit(next, replies, end)
                reply = await asyncio.wrap_future(step)
                if reply is end:
                    return
                yield reply
        finally:
            call.caller.leave()  # so that a step that waits for something ends
            if step is not None:
                step.add_done_callback(lambda _: replies.close())  # one that is at work cannot be closed

    async def _one(self, rpc: _Method, data: AsyncGenerator[Any, None], call: Call) -> Any:
        """The one message of a call, or what reads its bytes."""

        async def receive() -> Any:
            if (message := await anext(data, None)) is None:
                raise MalformedError(f"message of {call.method}", "none", "one")
            await data.aclose()
            return message

        return receive if rpc.served.reads_later else _noted(await receive(), call)

    async def _messages(self, rpc: _Method, data: AsyncIterator[Any], call: Call) -> AsyncIterator[Any]:
        """The messages of a stream."""
        async for message in data:
            yield _noted(message, call)
        if rpc.served.is_upload:  # the library ends the stream of one who has gone too, and then cancels it
            await asyncio.sleep(_GONE_S)

    @asynccontextmanager
    async def _call(self, rpc: _Method, context: Any) -> AsyncIterator[Call]:
        """Admit a call, count it, and turn what it raises into its status."""
        name, caller = rpc.name, Caller(partial(_seconds_left, context))
        call = Call(name, caller, self._pool, context.peer())
        call.times = CallTimes(call.begun, partial(self._metrics.timed, name), MOST_PAGES if self._traces else 0)
        headers = dict(context.invocation_metadata() or ()) if self._traces else {}
        ended = partial(self._ended, rpc, call, headers)
        task = asyncio.current_task()
        assert task is not None  # calls run in tasks
        mine = self._watching if rpc.served.is_watch else self._active
        mine.add(task)
        self._metrics.in_flight.inc()
        try:
            if self._refuses:
                raise _stopping(name)
            call.identity = self._identity(context)
            call.identity.check(rpc.served.role, f"call {name}", time.time())
            if not rpc.served.is_watch and len(self._active) > self._limits.concurrent_calls:
                got, expected = f"{len(self._active) - 1} at once", f"at most {self._limits.concurrent_calls}"
                raise OverloadedError("calls", got, f"{expected}; try again later", retry_s=1.0)
            yield call
            ended(grpc.StatusCode.OK, None)
        except (asyncio.CancelledError, GeneratorExit) as left:
            if task in self._told and isinstance(left, asyncio.CancelledError):
                task.uncancel()
                error = _stopping(name)
                ended(status_of(error), error)
                await context.abort(status_of(error), told(error), trailers(error))
            ended(_code_of_leaving(context), left)
            raise
        except Exception as error:
            code = _code_of_leaving(context) if isinstance(error, CallerLeft) else status_of(error)
            ended(code, error)
            let_go(error)  # the library keeps the error for a while, and so would it all that came
            await context.abort(code, told(error), trailers(error))
        finally:
            call.caller.leave()
            self._active.discard(task)
            self._watching.discard(task)
            self._told.discard(task)

    def _identity(self, context: Any) -> Identity:
        """Return the caller's identity, by the certificate of the connection.

        Raises:
            NotAllowedError: a certificate that cannot be read.
        """
        found = context.auth_context().get("x509_pem_cert")
        if found:
            return identity_of(found[0])
        return STRANGER if self._secured else LOCAL

    def _ended(
        self, rpc: _Method, call: Call, headers: dict[str, Any], code: grpc.StatusCode, error: BaseException | None
    ) -> None:
        """Count a call, before its caller hears of its end."""
        ended, reason = time.perf_counter(), reason_told(error)
        call.times.end(ended)
        self._metrics.in_flight.dec()
        self._metrics.call_ended(call.method, code.name, reason, None if rpc.served.is_watch else ended - call.begun)
        if self._traces is not None:
            self._traces.ended(call, rpc.service, headers, code, reason, ended)
        fields = {"method": call.method, "peer": call.actor.name, "correlation_id": call.correlation_id}
        log_end(fields | {"seconds": round(ended - call.begun, 4)}, code, error, is_watch=rpc.served.is_watch)


class _Reader:
    """The caller of a stream of replies. What is made for one who takes none is dropped.

    What has been handed to gRPC by then stays there until the caller takes it or leaves: no status goes before it.

    Args:
        replies: the stream.
        stall: called when the caller has stalled.
    """

    def __init__(self, replies: AsyncGenerator[Any, None], stall: Callable[[], None]) -> None:
        self._replies, self._stall = replies, stall
        self._closing: asyncio.Future[None] | None = None

    def stalls(self) -> None:
        """Make no more replies; called from the loop while none is being made."""
        self._stall()
        self._closing = asyncio.ensure_future(self._replies.aclose())

    def check(self, name: str) -> None:
        """See that the caller of `name` did not stall.

        Raises:
            StalledError: it did.
        """
        if self._closing is not None:
            raise _slow(name)

    async def close(self) -> None:
        """Make no more replies."""
        await (self._replies.aclose() if self._closing is None else self._closing)


def _slow(name: str) -> StalledError:
    return StalledError(f"answer of {name}", "a reply that is not taken in time", "a faster reader")


def _noted(message: Any, call: Call) -> Any:
    """A message, whose correlation id is that of its call."""
    call.correlation_id = getattr(message, "correlation_id", "") or call.correlation_id
    call.caller.actor = call.actor
    return message


def _stopping(name: str) -> StoppingError:
    return StoppingError(f"call {name}", "a service that stops", "one that serves; call again")


def _seconds_left(context: Any) -> float:
    left = context.time_remaining()
    return math.inf if left is None else float(left)


def _code_of_leaving(context: Any) -> grpc.StatusCode:
    """A call that is cut off ran out of time, or its caller has gone."""
    late = _seconds_left(context) <= _EARLY_S
    return grpc.StatusCode.DEADLINE_EXCEEDED if late else grpc.StatusCode.CANCELLED
