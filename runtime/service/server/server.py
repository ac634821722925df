"""The server: gRPC, its health and reflection on an address, a graceful end, and nothing left behind."""

import asyncio
import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Self

import grpc
from grpc_health.v1 import health, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from lightpage.errors import InvalidInputError
from lightpage.runtime.client.wire.address import check_free, target_of
from lightpage.runtime.client.wire.channel import SERVER_KEEPALIVE, add_port
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.frames.inference_calls import (
    INFERENCE,
    PREFIX,
    InferenceCalls,
    UnknownCalls,
    large_messages,
)
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.monitoring.traces import Traces
from lightpage.runtime.service.server.certificates import Certificates
from lightpage.runtime.service.server.dispatcher import SERVICE, Dispatcher, Served
from lightpage.runtime.service.server.handlers import handlers
from lightpage.runtime.service.server.health_servicer import HealthServicer
from lightpage.runtime.service.server.message_gate import MessageGate

_LAST_WORD_S = 0.1
"""From NOT_SERVING to the end of those who watch: they hear it first."""
_END_S = 1.0
"""For calls that were told to end."""
_LOOK_S = 2.0

STORE_HEALTH = "lightpage.store"
"""Name under which health checks ask whether the store can be written."""

_log = logging.getLogger(__name__)


class LightpageServer:
    """A running service; use it in a `with` statement, or `start` and `stop` it.

    Calls are taken on an event loop in a thread of its own, so that one that sends its frames slowly costs no thread.
    What computes runs in threads.

    Args:
        plane: the service's logic.
        recalibrator: what recalibrates it.
        address: HOST:PORT; port 0 takes a free one.
        certificates: certificates with which it meets its callers, who must have some too; None for no TLS.
        inference: whether the Open Inference Protocol is served too.
        traces: are told of every call, None for none.
    """

    def __init__(
        self,
        plane: DataPlane,
        recalibrator: Recalibrator,
        address: str = "127.0.0.1:0",
        certificates: Certificates | None = None,
        inference: bool = True,
        traces: Traces | None = None,
    ) -> None:
        self._traces = traces
        self._plane, self._recalibrator, self._address = plane, recalibrator, address
        self._credentials = None if certificates is None else certificates.server_credentials()
        if certificates is not None:
            plane.metrics.watch_certificates(certificates.ends_s)
        self._services = [Served(SERVICE, handlers(plane, recalibrator))]
        if inference:
            self._services.append(Served(INFERENCE, (InferenceCalls(plane),), PREFIX))
        self._inference = inference
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name="lightpage-rpc", daemon=True)
        self._pool = ThreadPoolExecutor(plane.limits.concurrent_calls, thread_name_prefix="lightpage-call")
        self._names = ("", *(service.descriptor.full_name for service in self._services))
        self._store = plane.models.store.health
        self._serving = self._stopping = self._started = False
        self.port = 0

    def start(self) -> Self:
        """Listen and say SERVING.

        Raises:
            InvalidInputError: the address cannot be listened on.
        """
        self._thread.start()
        try:
            check_free("address", self._address)
            asyncio.run_coroutine_threadsafe(self._open(), self._loop).result()
        except BaseException as error:
            self._close()
            if isinstance(error, RuntimeError):
                expected = "a free HOST:PORT of this machine"
                raise InvalidInputError(f"address {self._address}", error, expected) from None
            raise
        return self

    @property
    def target(self) -> str:
        """Return where a client on this machine finds it."""
        return target_of(self._address, self.port)

    def health(self) -> dict[str, bool]:
        """Return whether the service, by its name, and its store serve now; checks of this server say the same.

        Raises:
            TimeoutError: its loop does not answer.
        """
        if self._loop.is_closed() or not self._started:
            return dict.fromkeys((*self._names, STORE_HEALTH), False)
        return asyncio.run_coroutine_threadsafe(self._look(), self._loop).result(_LOOK_S)

    def stop(self, grace_s: float | None = None) -> None:
        """Say NOT_SERVING, refuse new calls, let those in flight end within `grace_s`, then end the rest.

        Calls that only watch are ended at once. All that are refused or ended hear that the service stops.
        """
        if self._loop.is_closed():
            return
        grace_s = self._plane.limits.grace_s if grace_s is None else grace_s
        stopped = asyncio.run_coroutine_threadsafe(self._stop(grace_s), self._loop)
        self._recalibrator.close(grace_s)
        stopped.result()
        self._close()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    async def _open(self) -> None:
        limits, metrics = self._plane.limits, self._plane.metrics
        sent = [f"/{SERVICE.full_name}/{method.name}" for method in SERVICE.methods if method.client_streaming]
        gate = MessageGate(limits, large_messages(self._plane) if self._inference else {}, sent)
        self._server = grpc.aio.server(
            interceptors=(gate,),
            options=(
                ("grpc.max_receive_message_length", gate.largest),
                ("grpc.max_send_message_length", limits.reply_bytes),
                ("grpc.so_reuseport", 0),  # a second server on the port is a mistake, not a helper
                *SERVER_KEEPALIVE,
                *_connection_ages(limits),
            ),
        )
        self._dispatcher = Dispatcher(
            self._services, self._pool, limits, metrics, self._traces, secured=self._credentials is not None
        )
        self._server.add_generic_rpc_handlers(self._dispatcher.rpc_handlers())
        if self._inference:
            self._server.add_generic_rpc_handlers((UnknownCalls(metrics),))
        self._health = HealthServicer()
        await self._say(False)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        names = (*self._names[1:], health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, self._server)
        self.port = add_port(self._server, self._address, self._credentials)
        await self._server.start()
        await self._say(not self._plane.trouble())
        self._started = True

    async def _say(self, serving: bool) -> None:
        self._serving = serving
        await self._health.tell({**dict.fromkeys(self._names, serving), STORE_HEALTH: self._store.is_well()})

    async def _look(self) -> dict[str, bool]:
        trouble = self._plane.trouble()
        if bool(trouble) == self._serving and not self._stopping:
            if trouble:
                _log.error("not serving: %s", trouble)
            else:
                _log.warning("serving again")
            await self._say(not trouble)
        store = self._store.is_well()
        await self._health.tell({STORE_HEALTH: store})
        states = {**dict.fromkeys(self._names, self._serving), STORE_HEALTH: store}
        return {name: serves and not self._stopping for name, serves in states.items()}

    async def _stop(self, grace_s: float) -> None:
        self._stopping = True
        await self._health.enter_graceful_shutdown()
        self._dispatcher.refuse()
        if self._health.is_watched:
            await asyncio.sleep(_LAST_WORD_S)
        self._health.end_watches()
        self._dispatcher.end_watches()
        if not await self._dispatcher.ended_within(grace_s):
            self._dispatcher.end_all()
            await self._dispatcher.ended_within(_END_S)
        await self._server.stop(_END_S)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()
        if left := asyncio.all_tasks(self._loop):  # calls that hear of the end just now
            for task in left:
                task.cancel()
            self._loop.run_until_complete(asyncio.wait(left, timeout=_END_S))
        self._loop.run_until_complete(self._loop.shutdown_asyncgens())
        self._loop.close()

    def _close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._pool.shutdown(wait=False)


def _connection_ages(limits: Limits) -> list[tuple[str, int]]:
    """gRPC's options of how old a connection may become, and of the calls that are then still on it."""
    ages = {
        "grpc.max_connection_age_ms": limits.connection_age_s,
        "grpc.max_connection_age_grace_ms": limits.connection_grace_s,
    }
    return [(name, max(1, round(1000 * seconds))) for name, seconds in ages.items() if seconds is not None]
