"""Health checks are answered whatever the service is busy with, and fail when it does not do its work."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from lightpage.errors import InvalidInputError
from runtime.commands.healthcheck import is_serving
from runtime.rpc import health_process
from runtime.rpc.health_server import HealthServer, next_port
from runtime.service.heart import Heart

SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING
WAIT_S = 10.0


def until(condition: Callable[[], bool]) -> bool:
    end = time.monotonic() + WAIT_S
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    return condition()


def test_each_service_is_told_by_name() -> None:
    states = {"": True, "one": True, "other": False}
    with HealthServer("127.0.0.1:0", lambda: states) as health:
        assert until(lambda: is_serving(health.target)[0])
        assert is_serving(health.target, service="one")[0]
        assert not is_serving(health.target, service="other")[0]
        assert "NOT_FOUND" in is_serving(health.target, service="none")[1]
        states["one"] = False
        assert until(lambda: not is_serving(health.target, service="one")[0])
        assert is_serving(health.target)[0]
    assert "UNAVAILABLE" in is_serving(health.target, timeout_s=2)[1]


def test_a_service_that_says_nothing_does_not_serve() -> None:
    hang = threading.Event()

    def states() -> dict[str, bool]:
        if hang.is_set():
            time.sleep(2 * health_process.SILENCE_S)
        return {"": True}

    with HealthServer("127.0.0.1:0", states) as health:
        assert until(lambda: is_serving(health.target)[0])
        hang.set()
        assert until(lambda: not is_serving(health.target)[0])
        hang.clear()
        assert until(lambda: is_serving(health.target)[0])


def test_one_that_fails_to_say_does_not_serve() -> None:
    broken = threading.Event()

    def states() -> dict[str, bool]:
        if broken.is_set():
            raise RuntimeError("broken")
        return {"": True}

    with HealthServer("127.0.0.1:0", states) as health:
        assert until(lambda: is_serving(health.target)[0])
        broken.set()
        assert until(lambda: not is_serving(health.target)[0])


def test_watchers_hear_of_changes() -> None:
    states = {"": True}
    with HealthServer("127.0.0.1:0", lambda: states) as health, grpc.insecure_channel(health.target) as channel:
        assert until(lambda: is_serving(health.target)[0])
        watch = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest(), timeout=WAIT_S)
        assert next(watch).status == SERVING
        states[""] = False
        assert next(watch).status == NOT_SERVING
        watch.cancel()


def test_the_process_ends_with_the_service_even_if_that_is_killed() -> None:
    health = HealthServer("127.0.0.1:0", lambda: {"": True}).start()
    assert health._process is not None
    process = health._process._process.pid
    health._process._link.close()  # as the end of the service's process does
    assert until(lambda: not _is_there(process) or not is_serving(health.target, timeout_s=1)[0])
    health.stop()


def test_a_process_that_was_killed_is_started_again_at_its_port() -> None:
    with HealthServer("127.0.0.1:0", lambda: {"": True}) as health:
        assert until(lambda: is_serving(health.target)[0])
        assert health._process is not None
        os.kill(health._process._process.pid, signal.SIGKILL)
        assert until(lambda: not is_serving(health.target, timeout_s=1)[0])
        assert until(lambda: is_serving(health.target)[0])


def test_a_port_that_is_taken_is_named() -> None:
    with HealthServer("127.0.0.1:0", dict) as health, pytest.raises(InvalidInputError, match="in use") as error:
        HealthServer(health.target, dict).start()
    assert str(health.port) in str(error.value)


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


def test_a_decode_that_does_not_end_is_trouble() -> None:
    now = 0.0
    heart = Heart(10.0, lambda: now)
    assert heart.trouble() == ""
    with heart.at_work():
        now = 9.0
        assert heart.trouble() == ""
        with heart.at_work():
            now = 12.0
            assert heart.trouble() == "a decode has been running for 12 s"
    assert heart.trouble() == ""


def _is_there(process: int) -> bool:
    try:
        os.kill(process, 0)
        return os.waitpid(process, os.WNOHANG) == (0, 0)
    except (ProcessLookupError, ChildProcessError):
        return False
