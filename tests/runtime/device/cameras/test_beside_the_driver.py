"""What is asked of a GigE camera beside its driver, and of the kernel; and a driver that is missing."""

import socket
import struct
import threading
from collections.abc import Iterator

import pytest

from lightpage.errors import SourceError
from lightpage.runtime.device.cameras import gige_network
from lightpage.runtime.device.cameras.aravis_library import ENVIRONMENT, PACKAGE, aravis
from lightpage.runtime.device.cameras.gige_network import (
    CONTROL_PRIVILEGE,
    LARGEST_PACKET,
    read_register,
    receive_buffer_problem,
)

LOCAL = "127.0.0.1"


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """A socket at which registers are asked for."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind((LOCAL, 0))
        made.settimeout(60)
        monkeypatch.setattr(gige_network, "PORT", made.getsockname()[1])
        yield made


@pytest.mark.parametrize(
    ("answer", "value"),
    [
        (struct.pack(">HHHHI", 0, 0x81, 4, 1, 0xABCD), 0xABCD),
        (struct.pack(">HHHH", 0x8006, 0x81, 0, 1), 0),
        (struct.pack(">HHHHI", 0, 0x83, 4, 1, 0xABCD), None),
    ],
)
def test_a_register_is_asked_for_and_its_value_returned(
    camera: socket.socket, answer: bytes, value: int | None
) -> None:
    asked: list[bytes] = []

    def respond() -> None:
        message, sender = camera.recvfrom(64)
        asked.append(message)
        camera.sendto(answer, sender)

    other = threading.Thread(target=respond)
    other.start()
    assert read_register(LOCAL, CONTROL_PRIVILEGE, timeout_s=0.2 if value is None else 60, tries=1) == value
    other.join(60)
    assert asked == [bytes([0x42, 1]) + struct.pack(">HHHI", 0x80, 4, 1, 0x0A00)]


def test_silence_is_asked_three_times_and_is_no_answer(camera: socket.socket) -> None:
    assert read_register(LOCAL, CONTROL_PRIVILEGE, timeout_s=0.01) is None
    numbers = [struct.unpack(">H", camera.recv(64)[6:8])[0] for _ in range(3)]
    assert numbers == [1, 2, 3]
    camera.setblocking(False)
    with pytest.raises(BlockingIOError):
        camera.recv(64)
    camera.close()
    assert read_register(LOCAL, CONTROL_PRIVILEGE) is None
    with pytest.raises(SourceError, match=r"no\.host\.invalid"):
        read_register("no.host.invalid", CONTROL_PRIVILEGE)


def test_packets_and_buffers_are_as_large_as_the_kernel_lets_them(monkeypatch: pytest.MonkeyPatch) -> None:
    assert gige_network.route_mtu(LOCAL) == LARGEST_PACKET
    monkeypatch.setattr(gige_network, "may_read_packets", lambda: False)
    assert receive_buffer_problem(2048) == ""
    assert "net.core.rmem_max=1000000000" in receive_buffer_problem(1_000_000_000)
    monkeypatch.setattr(gige_network, "may_read_packets", lambda: True)
    assert receive_buffer_problem(1_000_000_000) == ""


@pytest.mark.parametrize(("path", "named"), [("/nowhere/none.so", "none.so"), ("libc.so.6", "arv_")])
def test_a_library_that_is_missing_or_another_one_is_named(
    path: str, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(ENVIRONMENT, path)
    with pytest.raises(SourceError, match=PACKAGE) as raised:
        aravis()
    assert named in raised.value.got
