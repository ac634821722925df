"""Regions of shared memory: bounded, let go of in time, and of a size that no client can change."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from lightpage.errors import InvalidInputError, LightpageError
from runtime.client.shared_memory import SharedMemory as ClientMemory
from runtime.service.shared_memory import Region, SharedMemory
from runtime.wire.shared_memory import HANDLE_BYTES, SIZE, memory_path
from tests.waiting import eventually

MOST = 4000


@pytest.fixture
def target(tmp_path: Path) -> Iterator[str]:
    """Where up to 4000 bytes of memory in three regions are shared."""
    with SharedMemory(memory_path(f"unix:{tmp_path}/s"), MOST, 3, silence_s=0.2):
        yield f"unix:{tmp_path}/s"


def all_is_free(target: str) -> bool:
    try:
        ClientMemory(target, MOST).close()
    except LightpageError:
        return False
    return True


def test_a_region_that_is_dropped_while_it_is_read_stays_until_then() -> None:
    region = Region(1000)
    with region.reading(0, 1000) as view:
        region.drop()
        region.drop()
        assert bytes(view) == bytes(1000)
        with pytest.raises(InvalidInputError) as error, region.reading(0, 1):
            pass
    assert error.value.subject == "header.shared.region"
    with pytest.raises(InvalidInputError) as error, Region(1000).reading(1, 1000):
        pass
    assert (error.value.subject, error.value.got) == ("header.shared.offset", "1")


def test_a_client_cannot_change_the_size_of_its_region(target: str) -> None:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(memory_path(target))
        connection.sendall(SIZE.pack(1000))
        answer, (descriptor,), _, _ = socket.recv_fds(connection, 100, 1)
        try:
            for size in (0, 999, 1001):
                with pytest.raises(PermissionError):
                    os.ftruncate(descriptor, size)
            with pytest.raises(PermissionError):
                fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)
        finally:
            os.close(descriptor)
        assert len(answer) == 1 + HANDLE_BYTES


def test_memory_is_bounded(target: str) -> None:
    for size in (MOST + 1, (1 << 63) - 1):
        with pytest.raises(LightpageError) as error:
            ClientMemory(target, size)
        assert f"1 to {MOST}" in str(error.value)
    with ClientMemory(target, 3000), pytest.raises(LightpageError):
        ClientMemory(target, 1001)
    eventually(lambda: all_is_free(target))
    regions = [ClientMemory(target, 1) for _ in range(3)]
    with pytest.raises(LightpageError) as error:
        ClientMemory(target, 1)
    assert "at most 3" in str(error.value)
    for region in regions:
        region.close()
    eventually(lambda: all_is_free(target))
    for size in (-1, 1 << 63, 1 << 64):
        with pytest.raises(InvalidInputError) as impossible:
            ClientMemory(target, size)
        assert impossible.value.subject == "size of shared memory"


@pytest.mark.parametrize("said", [b"", b"\x01\x02", SIZE.pack(1000) + b"more"])
def test_whoever_says_nothing_or_too_much_is_hung_up_on(target: str, said: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(60)
        connection.connect(memory_path(target))
        connection.sendall(said)
        with suppress(ConnectionResetError):  # what was not heard resets it
            while connection.recv(100):  # the region may have come before the rest was heard
                pass
    eventually(lambda: all_is_free(target))


def test_what_lies_where_the_socket_would_be_stays(tmp_path: Path) -> None:
    path = tmp_path / "s.memory"
    path.write_text("mine")
    with pytest.raises(InvalidInputError), SharedMemory(str(path), 1, 1, 1.0):
        pass
    assert path.read_text() == "mine"
