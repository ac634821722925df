"""Addresses: what gRPC would guess at is refused."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from lightpage.errors import InvalidInputError
from runtime.client.shared_memory import SharedMemory
from runtime.rpc.health_server import HealthServer, next_port
from runtime.service.shared_memory import SharedMemory as SharedRegions
from runtime.wire.address import check_address, check_free, host_and_port, names_machine
from runtime.wire.shared_memory import memory_path


@pytest.mark.parametrize("address", ["127.0.0.1:50051", "localhost:1", "[::1]:50051", "unix:/tmp/lightpage.sock"])
def test_host_and_port_are_taken(address: str) -> None:
    check_address("--address", address)


@pytest.mark.parametrize(
    "address", ["127.0.0.1", "127.0.0.1:", "127.0.0.1:99999", "::1:50051", ":50051", "a b:1", "h:0", "h:５０", "unix:"]
)
def test_anything_else_is_named(address: str) -> None:
    with pytest.raises(InvalidInputError, match=r"--address.*HOST:PORT"):
        check_address("--address", address)


def test_a_server_may_ask_for_any_free_port() -> None:
    check_address("--address", "127.0.0.1:0", least_port=0)


def test_why_an_address_cannot_be_listened_at_is_said() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(InvalidInputError, match=rf"address {address}: got Address already in use"):
            check_free("address", address)
    check_free("address", address)
    with pytest.raises(InvalidInputError, match=r"address nohost\.invalid:50: got .*(known|resolution)"):
        check_free("address", "nohost.invalid:50")
    with pytest.raises(InvalidInputError, match=r"address a+:50: got .*label"):
        check_free("address", f"{'a' * 64}:50")


def test_a_socket_that_somebody_listens_at_is_not_taken_away(tmp_path: Path) -> None:
    path = tmp_path / "s"
    check_free("address", f"unix:{path}")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()
        with pytest.raises(InvalidInputError, match="a process that listens there"):
            check_free("address", f"unix:{path}")
    check_free("address", f"unix:{path}")  # left behind
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInputError, match="no socket"):
        check_free("address", f"unix:{tmp_path / 'file'}")
    with pytest.raises(InvalidInputError, match="no folder"):
        check_free("address", f"unix:{tmp_path / 'none' / 's'}")


@pytest.mark.parametrize(("size", "fits"), [(107, True), (108, False), (300, False)])
def test_a_socket_path_longer_than_the_system_has_room_for_is_named(size: int, fits: bool, tmp_path: Path) -> None:
    path = f"{tmp_path}/{'s' * (size - len(str(tmp_path)) - 1)}"
    if fits:
        check_address("target", f"unix:{path}")
        check_free("address", f"unix:{path}")
        return
    for check in (check_address, check_free):
        with pytest.raises(InvalidInputError, match=f"{size} bytes.*at most 107"):
            check("address", f"unix:{path}")


def test_sockets_beside_the_services_own_are_looked_at_too(tmp_path: Path) -> None:
    target = f"unix:{tmp_path}/{'s' * (105 - len(str(tmp_path)) - 1)}"
    check_address("target", target)
    with pytest.raises(InvalidInputError, match="112 bytes"):
        SharedMemory(target, 10)
    with pytest.raises(InvalidInputError, match="112 bytes"):
        SharedRegions(memory_path(target), 10, 1, 1.0).__enter__()
    with pytest.raises(InvalidInputError, match="112 bytes"):
        HealthServer(next_port(target), dict)


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
