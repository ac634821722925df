"""A service that is back is found at once, calls that change nothing are repeated, and the others are not."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent import futures
from contextlib import contextmanager

import grpc
import pytest

from lightpage.errors import LightpageError
from runtime.client.client import LightpageClient
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.call import SERVICE
from runtime.wire.channel import REPEATABLE


class Failing(pb_grpc.LightpageServicer):
    """Is unavailable at first, to each method anew."""

    def __init__(self, failures: int = 0) -> None:
        self.left, self.asked = failures, 0

    def _answer(self, context: grpc.ServicerContext) -> None:
        self.asked += 1
        if self.left:
            self.left -= 1
            context.abort(grpc.StatusCode.UNAVAILABLE, "not yet")

    def ListModels(self, request: pb.ListModelsRequest, context: grpc.ServicerContext) -> pb.ListModelsReply:
        self._answer(context)
        return pb.ListModelsReply()

    def Rollback(self, request: pb.RollbackRequest, context: grpc.ServicerContext) -> pb.RollbackReply:
        self._answer(context)
        return pb.RollbackReply()


@contextmanager
def served(servicer: Failing, port: int = 0) -> Iterator[int]:
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=2))
    pb_grpc.add_LightpageServicer_to_server(servicer, server)  # type: ignore[no-untyped-call]
    port = server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    yield port
    server.stop(grace=None).wait(5)


def test_a_service_that_is_back_is_found_within_three_seconds() -> None:
    """gRPC's own pauses grow to two minutes, and after ten seconds of absence are at six or so."""
    with served(Failing()) as port:
        client = LightpageClient(f"127.0.0.1:{port}", timeout_s=5)
        assert client.models() == []
    until = time.monotonic() + 10
    while time.monotonic() < until:
        with pytest.raises(LightpageError, match="no connection"):
            client.rollback()
        time.sleep(0.1)
    with served(Failing(), port):
        back = time.monotonic()
        while True:
            try:
                client.rollback()
                break
            except LightpageError:
                assert time.monotonic() - back < 3
                time.sleep(0.02)
    client.close()


def test_calls_that_change_nothing_are_repeated() -> None:
    servicer = Failing(2)
    with served(servicer) as port, LightpageClient(f"127.0.0.1:{port}", timeout_s=10) as client:
        assert client.models() == []
    assert servicer.asked == 3


def test_calls_that_change_something_are_not() -> None:
    servicer = Failing(1)
    with (
        served(servicer) as port,
        LightpageClient(f"127.0.0.1:{port}", timeout_s=10) as client,
        pytest.raises(LightpageError, match="not yet"),
    ):
        client.rollback()
    assert servicer.asked == 1


def test_repeatable_calls_are_calls_of_the_contract() -> None:
    assert set(REPEATABLE) <= {method.name for method in SERVICE.methods}
