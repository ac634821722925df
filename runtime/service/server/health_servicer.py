"""The standard health protocol, all of its calls."""

import asyncio
from typing import Any

import grpc
from grpc_health.v1 import health, health_pb2

SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING


class HealthServicer(health.aio.HealthServicer):  # type: ignore[misc,name-defined]  # without types
    """The library's servicer, which also lists its services and can end all watches."""

    def __init__(self) -> None:
        super().__init__()
        self._watchers: set[asyncio.Task[Any]] = set()
        self._ending = False

    async def tell(self, states: dict[str, bool]) -> None:
        """Set the state of each named service."""
        for name, serves in states.items():
            await self.set(name, SERVING if serves else NOT_SERVING)

    async def List(self, request: health_pb2.HealthListRequest, context: Any) -> health_pb2.HealthListResponse:
        """See the protocol."""
        states = {name: health_pb2.HealthCheckResponse(status=state) for name, state in self._server_status.items()}
        return health_pb2.HealthListResponse(statuses=states)

    async def Watch(self, request: health_pb2.HealthCheckRequest, context: Any) -> None:
        """See the protocol."""
        task = asyncio.current_task()
        assert task is not None  # calls run in tasks
        self._watchers.add(task)
        try:
            await super().Watch(request, context)
        except asyncio.CancelledError:
            if not self._ending:
                raise
            task.uncancel()
            await context.abort(grpc.StatusCode.UNAVAILABLE, "the service stops")
        finally:
            self._watchers.discard(task)

    @property
    def is_watched(self) -> bool:
        """Return whether anybody watches."""
        return bool(self._watchers)

    def end_watches(self) -> None:
        """End all watches."""
        self._ending = True
        for task in self._watchers:
            task.cancel()
