"""A process that answers health checks, started by `health_server` with HOST:PORT [CA CERTIFICATE KEY].

Its stdin is a socket. The service writes a line of JSON every half second: names of services, and whether each serves.
Where no line comes any more, nothing serves, whatever the service still holds. The process is idle, so it answers at
once where the service is busy with decoding. It ends when the socket's other end does.
"""

from __future__ import annotations

import asyncio
import json
import socket
import sys
from pathlib import Path

import grpc
from grpc_health.v1 import health_pb2_grpc

from lightpage.errors import InvalidInputError
from lightpage.helper_process import parent_link
from lightpage.runtime.client.wire.channel import SERVER_KEEPALIVE, TlsFiles, add_port
from lightpage.runtime.service.server.certificates import Certificates
from lightpage.runtime.service.server.health_servicer import HealthServicer

SILENCE_S = 3.0
"""A service that says nothing for so long has stopped."""


async def serve(address: str, link: socket.socket, tls: TlsFiles | None = None, silence_s: float = SILENCE_S) -> None:
    """Answer health checks at an address until the link is closed; says first at which port, or why not.

    Args:
        address: HOST:PORT.
        link: to the service.
        tls: with which it answers; None for no TLS.
        silence_s: a service that says nothing for so long has stopped.
    """
    reader, writer = await asyncio.open_connection(sock=link)
    server = grpc.aio.server(options=(("grpc.so_reuseport", 0), *SERVER_KEEPALIVE))
    servicer = HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(servicer, server)
    await servicer.tell({"": False})
    try:
        credentials = None if tls is None else Certificates(tls).server_credentials(callers_too=False)
        port = add_port(server, address, credentials)
        await server.start()
    except (InvalidInputError, RuntimeError) as error:
        writer.write(json.dumps({"error": str(error)}).encode() + b"\n")
        await writer.drain()
        return
    writer.write(json.dumps({"port": port}).encode() + b"\n")
    await writer.drain()
    names = {""}
    while True:
        try:
            line = await asyncio.wait_for(reader.readline(), silence_s)
        except TimeoutError:
            states = dict.fromkeys(names, False)
        else:
            if not line:
                break
            states = json.loads(line)
        names |= states.keys()
        await servicer.tell(states)
    await server.stop(None)


if __name__ == "__main__":
    files = [Path(path) for path in sys.argv[2:]]
    asyncio.run(serve(sys.argv[1], parent_link(), TlsFiles(*files) if files else None))
