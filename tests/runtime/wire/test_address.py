"""Addresses: what gRPC would guess at is refused."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from lightpage.errors import InvalidInputError
from runtime.wire.address import check_address, check_free


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
