"""Addresses that gRPC would guess at are refused; a service that is back is found; what changes nothing is repeated."""

import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import grpc
import pytest

from lightpage.errors import InvalidInputError, LightpageError
from lightpage.runtime.client.answers import JobState
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from lightpage.runtime.client.wire.address import check_address, check_free, host_and_port, names_machine
from lightpage.runtime.client.wire.channel import REPEATABLE
from lightpage.runtime.service.server.dispatcher import SERVICE
from tests.clock import HandClock
from tests.runtime.service.stage import served
from tests.waiting import eventually


def refused(check: Callable[..., object], *given: object, **options: object) -> InvalidInputError:
    with pytest.raises(InvalidInputError) as error:
        check(*given, **options)
    return error.value


def test_host_and_port_are_taken_and_anything_else_is_named() -> None:
    for address in ("127.0.0.1:50051", "localhost:1", "[::1]:50051", "h:65535", "unix:/tmp/lightpage.sock"):
        check_address("--address", address)
    check_address("--address", "127.0.0.1:0", least_port=0)  # a server may ask for any free port
    for address in ("127.0.0.1", "127.0.0.1:", "h:65536", "::1:50051", ":50051", "a b:1", "h:0", "h:５０", "unix:"):
        assert refused(check_address, "--address", address).subject == "--address"


def test_what_is_in_the_way_of_an_address_is_said(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        error = refused(check_free, "address", address)
        assert (error.subject, error.got) == (f"address {address}", "Address already in use")
    check_free("address", address)
    for unknown in ("nohost.invalid:50", f"{'a' * 64}:50"):
        assert refused(check_free, "address", unknown).subject == f"address {unknown}"

    path = tmp_path / "s"
    check_free("address", f"unix:{path}")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()
        refused(check_free, "address", f"unix:{path}")
    check_free("address", f"unix:{path}")  # left behind
    (tmp_path / "file").touch()
    for place in ("file", "none/s"):
        refused(check_free, "address", f"unix:{tmp_path / place}")
    assert (tmp_path / "file").exists()


def test_a_socket_path_longer_than_the_system_has_room_for_is_named(tmp_path: Path) -> None:
    def path(size: int) -> str:
        return f"unix:{tmp_path}/{'s' * (size - len(str(tmp_path)) - 1)}"

    check_address("target", path(107))
    check_free("address", path(107))
    for size in (108, 300):
        for check in (check_address, check_free):
            assert f"{size} bytes" in refused(check, "address", path(size)).got


def test_names_that_a_stranger_can_choose_name_no_machine() -> None:
    known = ["127.0.0.1:9100", "[::1]:9100", "[2001:db8::1]", "192.0.2.10", "localhost:9100", "LOCALHOST."]
    known += ["device.localhost", "device.example:9100", "a.wild.example"]
    strange = ["a.b.wild.example", "rebound.example:9100", "127.0.0.1.rebound.example", "localhost.rebound.example"]
    for host in (*known, *strange, "", "["):
        assert names_machine(host, {"device.example", "*.wild.example"}) == (host in known), host


def test_an_ipv6_address_goes_into_brackets() -> None:
    for host, told in (("::1", "[::1]:5"), ("[::]", "[::]:5"), ("127.0.0.1", "127.0.0.1:5")):
        assert host_and_port(host, 5) == told


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


def test_a_service_that_is_back_is_found() -> None:
    with served(Failing()) as port:
        client = LightpageClient(f"127.0.0.1:{port}", timeout_s=20)
        assert client.models.list() == []
    with pytest.raises(LightpageError) as error:
        client.models.roll_back()
    assert error.value.subject == f"service at 127.0.0.1:{port}"

    def is_back() -> bool:
        try:
            return client.models.roll_back() == ("", "")
        except LightpageError:
            return False

    with served(Failing(), port):
        eventually(is_back)
    client.close()


def test_calls_that_change_nothing_are_repeated_and_others_are_not() -> None:
    servicer = Failing(2)
    with served(servicer) as port, LightpageClient(f"127.0.0.1:{port}", timeout_s=20) as client:
        assert client.models.list() == []
        assert servicer.asked == 3
        servicer.left = 1
        with pytest.raises(LightpageError):
            client.models.roll_back()
        assert servicer.asked == 4
    assert set(REPEATABLE) <= {method.name for method in SERVICE.methods}


def test_a_watch_goes_on_after_a_lost_connection_but_not_beyond_its_time() -> None:
    servicer, clock = Failing(2), HandClock()
    with served(servicer) as port, LightpageClient(f"127.0.0.1:{port}", clock=clock) as client:
        assert [job.state for job in client.jobs.watch("a", 10.0)] == [JobState.RUNNING, JobState.DONE]
        assert (servicer.asked, clock.now()) == (3, 1001.0)
        servicer.left = 1000
        with pytest.raises(LightpageError):
            list(client.jobs.watch("a", 10.25))
        assert clock.now() == 1011.25
        assert 3 + 21 <= servicer.asked <= 3 + 22  # the last call may take a quarter of a second, which is real
    with LightpageClient(f"127.0.0.1:{port}", clock=clock) as nobody:
        with pytest.raises(LightpageError):
            list(nobody.jobs.watch("a", 20))
        assert clock.now() == 1011.25  # who was never heard is not waited for


def test_a_proxy_of_the_environment_is_passed_by(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("no_proxy", "NO_PROXY", "no_grpc_proxy"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("grpc_proxy", "http://127.0.0.1:1")
    with served(Failing()) as port, LightpageClient(f"localhost:{port}", timeout_s=20) as client:
        client.models.list()
