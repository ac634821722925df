"""Health checks are answered whatever the service is busy with, and fail when it does not do its work."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from lightpage.errors import InvalidInputError
from lightpage.runtime.commands.service.healthcheck import is_serving
from lightpage.runtime.service.server.health_process import serve
from lightpage.runtime.service.server.health_server import HealthServer, next_port
from tests.waiting import eventually

SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING


async def answers(heard: dict[str, bool], *, silence_s: float = 60.0) -> list[int]:
    """What a watcher of "one" hears: before the service says something, then, and when it is silent."""
    ours, its = socket.socketpair()
    reader, writer = await asyncio.open_connection(sock=ours)
    serving = asyncio.ensure_future(serve("127.0.0.1:0", its, silence_s=silence_s))
    port = json.loads(await reader.readline())["port"]
    found = []
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        watch = stub.Watch(health_pb2.HealthCheckRequest(service="one"), timeout=60)
        found.append((await anext(aiter(watch))).status)
        writer.write(json.dumps(heard).encode() + b"\n")
        found.append((await anext(aiter(watch))).status)
        with pytest.raises(grpc.RpcError) as error:
            await stub.Check(health_pb2.HealthCheckRequest(service="none"), timeout=20)
        assert error.value.code() is grpc.StatusCode.NOT_FOUND
        if silence_s < 1:
            found.append((await anext(aiter(watch))).status)
        watch.cancel()
    writer.close()  # the end of the service
    await asyncio.wait_for(serving, 60)
    return found


def test_the_process_says_what_it_hears_and_that_silence_is_no_service() -> None:
    unknown = health_pb2.HealthCheckResponse.SERVICE_UNKNOWN
    assert asyncio.run(answers({"": True, "one": True})) == [unknown, SERVING]
    assert asyncio.run(answers({"": True, "one": False})) == [unknown, NOT_SERVING]
    assert asyncio.run(answers({"": True, "one": True}, silence_s=0.2)) == [unknown, SERVING, NOT_SERVING]


def test_one_that_fails_to_say_does_not_serve_and_a_killed_process_is_started_again() -> None:
    said: list[dict[str, bool]] = [{"": True, "other": False}]
    with HealthServer("127.0.0.1:0", lambda: said[0]) as health:  # fails where nothing is said
        eventually(lambda: is_serving(health.target)[0])
        assert not is_serving(health.target, service="other")[0]
        before = health.pid
        assert before is not None
        os.kill(before, signal.SIGKILL)
        eventually(lambda: health.pid != before and is_serving(health.target)[0])
        with pytest.raises(InvalidInputError) as error, HealthServer(health.target, dict):
            pass
        assert health.target in error.value.subject
        said.clear()
        eventually(lambda: not is_serving(health.target)[0])
    with pytest.raises(InvalidInputError):
        HealthServer("nonsense", dict)


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("127.0.0.1:50051", "127.0.0.1:50052"),
        ("[::1]:65535", "[::1]:0"),
        ("device.example:50051", "127.0.0.1:50052"),
        ("unix:/run/lightpage.sock", "unix:/run/lightpage.sock.health"),
    ],
)
def test_where_health_is_asked_by_default(address: str, expected: str) -> None:
    assert next_port(address) == expected
