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


@pytest.mark.parametrize("address", ["127.0.0.1:50051", "localhost:1", "[::1]:50051", "unix:/tmp/lightpage.sock"])
def test_host_and_port_are_taken(address: str) -> None:
    check_address("--address", address)


@pytest.mark.parametrize(
    "address", ["127.0.0.1", "127.0.0.1:", "127.0.0.1:99999", "::1:50051", ":50051", "a b:1", "h:0", "h:５０", "unix:"]
)
def test_anything_else_is_named(address: str) -> None:
    assert refused(check_address, "--address", address).subject == "--address"


def test_a_server_may_ask_for_any_free_port() -> None:
    check_address("--address", "127.0.0.1:0", least_port=0)


def test_why_an_address_cannot_be_listened_at_is_said() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        error = refused(check_free, "address", address)
        assert (error.subject, error.got) == (f"address {address}", "Address already in use")
    check_free("address", address)
    for unknown in ("nohost.invalid:50", f"{'a' * 64}:50"):
        assert refused(check_free, "address", unknown).subject == f"address {unknown}"


def test_a_socket_that_somebody_listens_at_is_not_taken_away(tmp_path: Path) -> None:
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
        assert "112 bytes" in refused(make).got  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("host", "known"),
    [
        ("127.0.0.1:9100", True),
        ("[::1]:9100", True),
        ("[2001:db8::1]", True),
        ("192.0.2.10", True),
        ("localhost:9100", True),
        ("LOCALHOST.", True),
        ("device.localhost", True),
        ("device.example:9100", True),
        ("a.wild.example", True),
        ("a.b.wild.example", False),
        ("rebound.example:9100", False),
        ("127.0.0.1.rebound.example", False),
        ("localhost.rebound.example", False),
        ("", False),
        ("[", False),
    ],
)
def test_names_that_a_stranger_can_choose_name_no_machine(host: str, known: bool) -> None:
    assert names_machine(host, {"device.example", "*.wild.example"}) == known


@pytest.mark.parametrize(("host", "told"), [("::1", "[::1]:5"), ("[::]", "[::]:5"), ("127.0.0.1", "127.0.0.1:5")])
def test_an_ipv6_address_goes_into_brackets(host: str, told: str) -> None:
    assert host_and_port(host, 5) == told
