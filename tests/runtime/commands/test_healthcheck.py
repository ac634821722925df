"""The health probe says yes only to a server that serves."""

from __future__ import annotations

import socket
from concurrent import futures

import grpc
from click.testing import CliRunner
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from runtime.commands.healthcheck import is_serving, main


def test_the_exit_code_is_the_answer() -> None:
    grpc_server, servicer = grpc.server(futures.ThreadPoolExecutor(max_workers=2)), health.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(servicer, grpc_server)
    target, runner = f"127.0.0.1:{grpc_server.add_insecure_port('127.0.0.1:0')}", CliRunner()
    by_environment = {"LIGHTPAGE_HEALTH_TARGET": target}
    grpc_server.start()
    for status, code in (("SERVING", 0), ("NOT_SERVING", 1)):
        servicer.set("", health_pb2.HealthCheckResponse.ServingStatus.Value(status))
        assert runner.invoke(main, env=by_environment).exit_code == code
        assert is_serving(target) == (not code, f"{target}: {status}")
    assert runner.invoke(main, ["--target", target, "--service", "nobody.v1.Nothing"]).exit_code == 1
    assert "NOT_FOUND" in is_serving(target, service="nobody.v1.Nothing")[1]
    grpc_server.stop(grace=None).wait(5)
    serving, said = is_serving(target, timeout_s=2.0)
    assert (serving, "UNAVAILABLE" in said or "DEADLINE_EXCEEDED" in said) == (False, True)


def test_a_silent_server_is_not_healthy_and_is_not_waited_for() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        assert not is_serving(f"127.0.0.1:{silent.getsockname()[1]}", timeout_s=0.2)[0]
