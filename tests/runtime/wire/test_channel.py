"""A service that is back is found, calls that change nothing are repeated, and watches of jobs go on."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent import futures
from contextlib import contextmanager

import grpc
import pytest

from lightpage.errors import LightpageError
from runtime.client.answers import JobState
from runtime.client.client import LightpageClient
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.call import SERVICE
from runtime.wire.channel import REPEATABLE
from tests.clock import HandClock
from tests.waiting import eventually


class Failing(pb_grpc.LightpageServicer):
    """Is unavailable so many times at first."""

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

    def WatchJob(self, request: pb.WatchJobRequest, context: grpc.ServicerContext) -> Iterator[pb.Job]:
        yield pb.Job(id=request.id, state=pb.JOB_STATE_RUNNING)
        self._answer(context)
        yield pb.Job(id=request.id, state=pb.JOB_STATE_DONE)


@contextmanager
def served(servicer: Failing, port: int = 0) -> Iterator[int]:
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=2))
    pb_grpc.add_LightpageServicer_to_server(servicer, server)  # type: ignore[no-untyped-call]
    port = server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    yield port
    server.stop(grace=None).wait(60)


def test_a_service_that_is_back_is_found() -> None:
    with served(Failing()) as port:
        client = LightpageClient(f"127.0.0.1:{port}", timeout_s=20)
        assert client.models() == []
    with pytest.raises(LightpageError) as error:
        client.rollback()
    assert error.value.subject == f"service at 127.0.0.1:{port}"

    def is_back() -> bool:
        try:
            return client.rollback() == ("", "")
        except LightpageError:
            return False

    with served(Failing(), port):
        eventually(is_back)
    client.close()


def test_calls_that_change_nothing_are_repeated_and_others_are_not() -> None:
    servicer = Failing(2)
    with served(servicer) as port, LightpageClient(f"127.0.0.1:{port}", timeout_s=20) as client:
        assert client.models() == []
        assert servicer.asked == 3
        servicer.left = 1
        with pytest.raises(LightpageError):
            client.rollback()
        assert servicer.asked == 4
    assert set(REPEATABLE) <= {method.name for method in SERVICE.methods}


def test_a_watch_goes_on_after_a_lost_connection_but_not_beyond_its_time() -> None:
    servicer, clock = Failing(2), HandClock()
    with served(servicer) as port, LightpageClient(f"127.0.0.1:{port}", clock=clock) as client:
        assert [job.state for job in client.watch_job("a", 10.0)] == [JobState.RUNNING, JobState.DONE]
        assert (servicer.asked, clock.now()) == (3, 1001.0)
        servicer.left = 1000
        with pytest.raises(LightpageError):
            list(client.watch_job("a", 10.25))
        assert (servicer.asked, clock.now()) == (3 + 22, 1011.25)
    with LightpageClient(f"127.0.0.1:{port}", clock=clock) as nobody:
        with pytest.raises(LightpageError):
            list(nobody.watch_job("a", 20))
        assert clock.now() == 1011.25  # who was never heard is not waited for
