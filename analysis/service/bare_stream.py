"""A server that takes streams of bytes and does nothing with them: what any call over gRPC costs at least.

``python -m analysis.service.bare_stream`` prints the port that it listens on, on loopback, and ends with its stdin.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator
from typing import Any

import grpc

PATH = "/bare.Stream/Take"
MESSAGE_BYTES = 4 << 20


async def take(parts: AsyncIterator[bytes], context: Any) -> bytes:
    """Count the bytes that come, and return their number as text."""
    count = 0
    async for part in parts:
        count += len(part)
    return str(count).encode()


async def serve() -> None:
    """Serve until stdin is closed."""
    server = grpc.aio.server(options=(("grpc.max_receive_message_length", MESSAGE_BYTES),))
    method = grpc.stream_unary_rpc_method_handler(take)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("bare.Stream", {"Take": method}),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    print(port, flush=True)
    await asyncio.to_thread(sys.stdin.read)
    await server.stop(None)


if __name__ == "__main__":
    asyncio.run(serve())
