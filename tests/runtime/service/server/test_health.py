"""Health checks are answered whatever the service is busy with, and fail when it does not do its work."""

import os
import signal
import sys

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from lightpage.errors import InvalidInputError
from lightpage.runtime.commands.service.healthcheck import is_serving
from lightpage.runtime.service.server.health_process import HealthAnswers
from lightpage.runtime.service.server.health_server import HealthServer, next_port
from tests.waiting import eventually

SERVING, NOT_SERVING = health_pb2.HealthCheckResponse.SERVING, health_pb2.HealthCheckResponse.NOT_SERVING


def test_the_process_says_what_it_hears_and_that_silence_is_no_service() -> None:
    answers = HealthAnswers()
    port = answers.listen("127.0.0.1:0", None)
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        watch = stub.Watch(health_pb2.HealthCheckRequest(service="one"), timeout=60)
        assert next(watch).status == health_pb2.HealthCheckResponse.SERVICE_UNKNOWN
        for serves, status in ((True, SERVING), (False, NOT_SERVING), (True, SERVING)):
            answers.tell({"": True, "one": serves})
            assert next(watch).status == status
        answers.idle()  # as the process does after some time
        assert next(watch).status == NOT_SERVING
        with pytest.raises(grpc.RpcError) as error:
            stub.Check(health_pb2.HealthCheckRequest(service="none"), timeout=20)
        assert error.value.code() is grpc.StatusCode.NOT_FOUND
        watch.cancel()
    answers.close()


def test_one_that_fails_to_say_does_not_serve_and_a_killed_process_is_started_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    said: list[dict[str, bool]] = [{"": True, "other": False}]
    with HealthServer("127.0.0.1:0", lambda: said[0]) as health:  # fails where nothing is said
        eventually(lambda: is_serving(health.target)[0])
        assert not is_serving(health.target, service="other")[0]
        before = health.pid
        assert before is not None
        with monkeypatch.context() as none_left:
            none_left.setattr(sys, "executable", "/nowhere/python")
            for pause in ("_AGAIN_S", "_BEAT_S"):
                none_left.setattr(f"lightpage.runtime.service.server.health_server.{pause}", 0.0)
            os.kill(before, signal.SIGKILL)
            eventually(lambda: len(caplog.records) > 6)  # it fails to start time and again
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
