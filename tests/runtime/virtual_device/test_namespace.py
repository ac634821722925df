"""A private network has both addresses of the fake cameras, and nothing else."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

import pytest

from runtime.errors import SourceError
from runtime.virtual_device import namespace
from tests.skips import NO_NETWORKS

PROGRAM = """
import socket
first, second = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
first.bind(("127.0.0.1", 3956))
second.bind(("127.0.0.2", 3956))
first.sendto(b"hello", ("127.0.0.2", 3956))
assert second.recv(16) == b"hello"
assert [name for _, name in socket.if_nameindex()] == ["lo"]
raise SystemExit(7)
"""


def test_both_addresses_no_way_out_and_the_exit_code() -> None:
    if namespace.available() is not None:
        pytest.skip(NO_NETWORKS)
    run = subprocess.run(namespace.enter([sys.executable, "-c", PROGRAM]), timeout=60)
    assert run.returncode == 7


def test_a_machine_that_cannot_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", os.devnull)
    namespace.available.cache_clear()
    try:
        assert "util-linux" in (namespace.available() or "")
        with pytest.raises(SourceError, match=r"^private network"):
            namespace.require()
    finally:
        namespace.available.cache_clear()


def test_a_shared_network_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(1, "lo"), (2, "eth0")])
    with pytest.raises(SystemExit, match="other interfaces"):
        namespace.main(["true"])
