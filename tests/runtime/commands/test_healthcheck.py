"""The health probe says yes only to a server that serves."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from concurrent import futures
from dataclasses import dataclass

import grpc
import pytest
from click.testing import CliRunner
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from runtime.commands.healthcheck import is_serving, main

SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING


@dataclass(frozen=True)
class HealthServer:
    """A server on loopback that has nothing but its health."""

    target: str
    servicer: health.HealthServicer


@pytest.fixture
def server() -> Iterator[HealthServer]:
    grpc_server = grpc.server(futures.ThreadPoolExecutor(max_workers=2))
    servicer = health.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(servicer, grpc_server)
    port = grpc_server.add_insecure_port("127.0.0.1:0")
    grpc_server.start()
    yield HealthServer(f"127.0.0.1:{port}", servicer)
    grpc_server.stop(grace=None).wait(5)


@pytest.mark.parametrize(
    ("status", "service", "serving", "word"),
    [
        (SERVING, "", True, "SERVING"),
        (NOT_SERVING, "", False, "NOT_SERVING"),
        (NOT_SERVING, "lightpage.v1.Decoder", False, "NOT_SERVING"),
        (None, "nobody.v1.Nothing", False, "NOT_FOUND"),
    ],
)
def test_a_server_says_how_it_fares(
    server: HealthServer, status: int | None, service: str, serving: bool, word: str
) -> None:
    server.servicer.set("", SERVING)
    if status is not None:
        server.servicer.set(service, status)
    found, said = is_serving(server.target, service=service)
    assert (found, word in said) == (serving, True)


def test_nobody_at_home_is_not_healthy() -> None:
    with socket.socket() as held:  # bound and not listening: nothing else can take the port meanwhile
        held.bind(("127.0.0.1", 0))
        serving, said = is_serving(f"127.0.0.1:{held.getsockname()[1]}", timeout_s=2.0)
    assert not serving
    assert "UNAVAILABLE" in said or "DEADLINE_EXCEEDED" in said


def test_a_silent_server_is_not_healthy_and_is_not_waited_for() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        assert not is_serving(f"127.0.0.1:{silent.getsockname()[1]}", timeout_s=0.2)[0]


def test_the_exit_code_is_the_answer(server: HealthServer) -> None:
    runner = CliRunner()
    assert runner.invoke(main, ["--target", server.target]).exit_code == 0
    by_environment = {"LIGHTPAGE_HEALTH_TARGET": server.target}
    assert runner.invoke(main, env=by_environment).exit_code == 0
    server.servicer.set("", NOT_SERVING)
    assert runner.invoke(main, env=by_environment).exit_code == 1
