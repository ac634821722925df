"""A private network has both addresses of the fake cameras, and nothing else."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

import pytest

from runtime.errors import SourceError
from runtime.virtual_device import namespace


@pytest.mark.own_network
def test_both_addresses_and_no_way_out() -> None:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in namespace.ADDRESSES]
    try:
        for one, address in zip(sockets, namespace.ADDRESSES, strict=True):
            one.bind((address, 3956))
        sockets[0].sendto(b"hello", (namespace.ADDRESSES[1], 3956))
        sockets[1].settimeout(5.0)
        assert sockets[1].recv(16) == b"hello"
    finally:
        for one in sockets:
            one.close()
    assert [name for _, name in socket.if_nameindex()] == ["lo"]


@pytest.mark.own_network
def test_the_exit_code_comes_through() -> None:
    run = subprocess.run(namespace.enter([sys.executable, "-c", "raise SystemExit(7)"]), timeout=60)
    assert run.returncode == 7


def test_a_machine_that_cannot_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", os.devnull)
    namespace.available.cache_clear()
    try:
        assert "util-linux" in (namespace.available() or "")
        with pytest.raises(SourceError, match=r"private network.*unshare"):
            namespace.require()
    finally:
        namespace.available.cache_clear()


def test_a_shared_network_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(1, "lo"), (2, "eth0")])
    with pytest.raises(SystemExit, match="other interfaces"):
        namespace.main(["true"])
