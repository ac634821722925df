"""Answers health checks in a process of its own, for `health_server`.

The service tells every half second whether each of its services serves. Where it says nothing any more, nothing serves,
whatever the service still holds. The process is idle, so it answers at once where the service is busy with decoding.
"""

import asyncio
import threading
from collections.abc import Coroutine
from typing import Any

import grpc
from grpc_health.v1 import health_pb2_grpc

from lightpage.errors import InvalidInputError
from lightpage.helper_process import Helper
from lightpage.runtime.client.wire.channel import SERVER_KEEPALIVE, TlsFiles, add_port
from lightpage.runtime.service.server.certificates import Certificates
from lightpage.runtime.service.server.health_servicer import HealthServicer


class HealthAnswers(Helper):
    """Serves the health protocol from a thread."""

    idle_s = 3.0
    """A service that says nothing for so long has stopped."""
    farewell_s = 1.0

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, name="lightpage-health", daemon=True).start()
        self._servicer = HealthServicer()
        self._names = {""}

    def listen(self, address: str, tls: TlsFiles | None) -> int:
        """Answer at an address, HOST:PORT, with TLS or without; returns the port.

        Raises:
            InvalidInputError: it cannot be listened on.
        """
        self.idle()
        port: int = self._run(self._listen(address, tls))
        return port

    def tell(self, states: dict[str, bool]) -> None:
        """Say of each service whether it serves."""
        self._names |= states.keys()
        self._run(self._servicer.tell(states))

    def idle(self) -> None:
        """Say that nothing serves."""
        self.tell(dict.fromkeys(self._names, False))

    def close(self) -> None:
        """Answer no more."""
        self._run(self._server.stop(None))

    async def _listen(self, address: str, tls: TlsFiles | None) -> int:
        server = self._server = grpc.aio.server(options=(("grpc.so_reuseport", 0), *SERVER_KEEPALIVE))
        health_pb2_grpc.add_HealthServicer_to_server(self._servicer, server)
        try:
            credentials = None if tls is None else Certificates(tls).server_credentials(callers_too=False)
            port = add_port(server, address, credentials)
            await server.start()
        except (InvalidInputError, RuntimeError) as error:
            raise InvalidInputError(f"health address {address}", error, "a free HOST:PORT of this machine") from None
        return port

    def _run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()
