"""The server process: gRPC with health on an address, a graceful end, and nothing left behind."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Self

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from lightpage.errors import InvalidInputError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.servicer import LightpageServicer
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.wire.address import check_free

SERVICE: str = pb.DESCRIPTOR.services_by_name["Lightpage"].full_name

_WATCHERS = 4
"""Threads for health watchers, apart from those of the calls: watching must not take a decode's place."""

_KEEPALIVE_MS = 30_000
"""A connection silent for so long is asked for a sign of life, so that a dead client's call ends."""


class LightpageServer:
    """A running service; use it in a `with` statement, or `start` and `stop` it.

    Args:
        plane: the service's logic.
        recalibrator: what recalibrates it.
        address: HOST:PORT; port 0 takes a free one.
    """

    def __init__(self, plane: DataPlane, recalibrator: Recalibrator, address: str = "127.0.0.1:0") -> None:
        limits = plane.limits
        self._plane, self._recalibrator, self._address = plane, recalibrator, address
        self._pool = ThreadPoolExecutor(limits.worker_threads, thread_name_prefix="lightpage-call")
        self._health_pool = ThreadPoolExecutor(_WATCHERS, thread_name_prefix="lightpage-health")
        self._health = health.HealthServicer(experimental_non_blocking=True, experimental_thread_pool=self._health_pool)
        self._server = grpc.server(
            self._pool,
            maximum_concurrent_rpcs=limits.concurrent_calls,
            options=(
                ("grpc.max_receive_message_length", limits.message_bytes),
                ("grpc.max_send_message_length", limits.reply_bytes),
                ("grpc.so_reuseport", 0),  # a second server on the port is a mistake, not a helper
                ("grpc.keepalive_time_ms", _KEEPALIVE_MS),
            ),
        )
        servicer = LightpageServicer(plane, recalibrator)
        pb_grpc.add_LightpageServicer_to_server(servicer, self._server)  # type: ignore[no-untyped-call]
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        self.port = 0

    def start(self) -> Self:
        """Listen and say SERVING.

        Raises:
            InvalidInputError: the address cannot be listened on.
        """
        try:
            check_free("address", self._address)
            self.port = self._server.add_insecure_port(self._address)
        except InvalidInputError:
            self._close_pools()
            raise
        except RuntimeError as error:
            self._close_pools()
            raise InvalidInputError(f"address {self._address}", error, "a free HOST:PORT of this machine") from None
        self._server.start()
        for name in ("", SERVICE):
            self._health.set(name, health_pb2.HealthCheckResponse.SERVING)
        return self

    @property
    def target(self) -> str:
        """Where a client on this machine finds it."""
        if self._address.startswith("unix:"):
            return self._address
        host = self._address.rpartition(":")[0]
        return f"{'127.0.0.1' if host in ('0.0.0.0', '[::]', '') else host}:{self.port}"

    def stop(self, grace_s: float | None = None) -> None:
        """Say NOT_SERVING, take no new calls, let those in flight end within `grace_s`, then end the rest."""
        self._health.enter_graceful_shutdown()
        grace_s = self._plane.limits.grace_s if grace_s is None else grace_s
        stopped = self._server.stop(grace_s)
        self._recalibrator.close(grace_s)
        stopped.wait()
        self._close_pools()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _close_pools(self) -> None:
        self._pool.shutdown(wait=False)
        self._health_pool.shutdown(wait=False)
