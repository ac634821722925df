"""Addresses: what gRPC would guess at is refused."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from lightpage.errors import InvalidInputError
from runtime.client.shared_memory import SharedMemory
from runtime.rpc.health_server import HealthServer, next_port
from runtime.service.shared_memory import SharedMemory as SharedRegions
from runtime.wire.address import check_address, check_free, host_and_port, names_machine
from runtime.wire.shared_memory import memory_path


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
    # sockets beside the service's own are looked at too
    target = path(105)
    check_address("target", target)
    for make in (
        lambda: SharedMemory(target, 10),
        lambda: SharedRegions(memory_path(target), 10, 1, 1.0).__enter__(),
        lambda: HealthServer(next_port(target), dict),
    ):
        assert "112 bytes" in refused(make).got


def test_names_that_a_stranger_can_choose_name_no_machine() -> None:
    known = ["127.0.0.1:9100", "[::1]:9100", "[2001:db8::1]", "192.0.2.10", "localhost:9100", "LOCALHOST."]
    known += ["device.localhost", "device.example:9100", "a.wild.example"]
    strange = ["a.b.wild.example", "rebound.example:9100", "127.0.0.1.rebound.example", "localhost.rebound.example"]
    for host in (*known, *strange, "", "["):
        assert names_machine(host, {"device.example", "*.wild.example"}) == (host in known), host


def test_an_ipv6_address_goes_into_brackets() -> None:
    for host, told in (("::1", "[::1]:5"), ("[::]", "[::]:5"), ("127.0.0.1", "127.0.0.1:5")):
        assert host_and_port(host, 5) == told
