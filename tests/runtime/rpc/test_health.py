"""Health checks are answered whatever the service is busy with, and fail when it does not do its work."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
from collections.abc import Iterator

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from lightpage.errors import InvalidInputError
from runtime.commands.healthcheck import is_serving
from runtime.rpc.health_process import serve
from runtime.rpc.health_server import HealthServer, next_port
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


class States:
    """What a service says of itself, or that it fails to."""

    def __init__(self) -> None:
        self.said: dict[str, bool] | None = {"": True, "one": True, "other": False}

    def __call__(self) -> dict[str, bool]:
        if self.said is None:
            raise RuntimeError("broken")
        return self.said


@pytest.fixture(scope="module")
def states() -> States:
    return States()


@pytest.fixture(scope="module")
def health(states: States) -> Iterator[HealthServer]:
    with HealthServer("127.0.0.1:0", states) as running:
        eventually(lambda: is_serving(running.target)[0])
        yield running


def test_each_service_is_told_by_name_and_watchers_hear_of_changes(health: HealthServer, states: States) -> None:
    assert is_serving(health.target, service="one")[0]
    assert not is_serving(health.target, service="other")[0]
    assert "NOT_FOUND" in is_serving(health.target, service="none")[1]
    with grpc.insecure_channel(health.target) as channel:
        watch = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest(service="one"), timeout=60)
        assert next(watch).status == SERVING
        states.said = {"": True, "one": False, "other": False}
        assert next(watch).status == NOT_SERVING
        watch.cancel()
    assert is_serving(health.target)[0]
    states.said = {"": True}


def test_one_that_fails_to_say_does_not_serve_and_a_killed_process_is_started_again(
    health: HealthServer, states: States
) -> None:
    before = health.pid
    assert before is not None
    os.kill(before, signal.SIGKILL)
    eventually(lambda: health.pid != before and is_serving(health.target)[0])
    states.said = None
    eventually(lambda: not is_serving(health.target)[0])
    states.said = {"": True}
    eventually(lambda: is_serving(health.target)[0])


def test_a_port_that_is_taken_is_named(health: HealthServer) -> None:
    with pytest.raises(InvalidInputError) as error:
        HealthServer(health.target, dict).start()
    assert health.target in error.value.subject
    with pytest.raises(InvalidInputError):
        HealthServer("nonsense", dict)


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("127.0.0.1:50051", "127.0.0.1:50052"),
        ("127.0.0.1:0", "127.0.0.1:0"),
        ("[::1]:65535", "[::1]:0"),
        ("0.0.0.0:50051", "127.0.0.1:50052"),
        ("device.example:50051", "127.0.0.1:50052"),
        ("unix:/run/lightpage.sock", "unix:/run/lightpage.sock.health"),
    ],
)
def test_where_health_is_asked_by_default(address: str, expected: str) -> None:
    assert next_port(address) == expected
