"""Addresses: what gRPC would guess at is refused."""

from __future__ import annotations

import pytest

from optics.errors import InvalidInputError
from runtime.address import check_address


@pytest.mark.parametrize("address", ["127.0.0.1:50051", "localhost:1", "[::1]:50051", "unix:/tmp/lightpage.sock"])
def test_host_and_port_are_taken(address: str) -> None:
    check_address("--address", address)


@pytest.mark.parametrize(
    "address", ["127.0.0.1", "127.0.0.1:", "127.0.0.1:99999", "::1:50051", ":50051", "a b:1", "h:0"]
)
def test_anything_else_is_named(address: str) -> None:
    with pytest.raises(InvalidInputError, match=r"--address.*HOST:PORT"):
        check_address("--address", address)


def test_a_server_may_ask_for_any_free_port() -> None:
    check_address("--address", "127.0.0.1:0", least_port=0)
