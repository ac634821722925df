"""What is asked of a GigE camera beside its driver and of the kernel, and what drivers are named and hand over."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from lightpage.errors import FrameError
from runtime.cameras import gige_network
from runtime.cameras.aravis_library import ENVIRONMENT, PACKAGE, aravis
from runtime.cameras.gentl_device import pixel_bytes
from runtime.cameras.gige_network import CONTROL_PRIVILEGE, LARGEST_PACKET, read_register, receive_buffer_problem
from runtime.cameras.pixel_formats import pack
from runtime.errors import SourceError

LOCAL = "127.0.0.1"
SHAPE = (6, 16)


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


@pytest.mark.parametrize("given", [{}, {"padding_x": 4}, {"image_offset": 32}, {"padding_x": 4, "image_offset": 32}])
def test_what_surrounds_the_pixels_is_left_out(given: dict[str, int]) -> None:
    pixels = pack(np.random.default_rng(1).integers(0, 4096, SHAPE, np.uint16), "Mono12p")
    lines = np.pad(pixels.reshape(SHAPE[0], -1), ((0, 0), (0, given.get("padding_x", 0))), constant_values=0xA5)
    content = bytes(given.get("image_offset", 0)) + lines.tobytes()
    for behind in (b"", bytes(300)):
        buffer = SimpleNamespace(raw_buffer=content + behind, **given)
        assert pixel_bytes(buffer, SHAPE, "Mono12p", (AttributeError,)) == pixels.tobytes()


@pytest.mark.parametrize("padding", [0, 4])
def test_too_few_bytes_are_a_fault_of_the_frame(padding: int) -> None:
    with pytest.raises(FrameError, match="95"):
        pixel_bytes(SimpleNamespace(raw_buffer=bytes(95), padding_x=padding), SHAPE, "Mono8", (AttributeError,))
