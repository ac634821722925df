"""What a GenTL producer hands over besides pixels; a device without a producer stands in for a camera."""

from __future__ import annotations

import mmap
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.cameras.gentl_device import CameraRefusedError, GenTLDevice
from runtime.cameras.pixel_formats import pack, pixel_format
from runtime.cameras.settings import CameraSettings

SHAPE = (6, 16)


class ProducerError(Exception):
    """As producers raise it for what they do not know."""


def device_of(name: str = "Mono8", payload: int = 0) -> GenTLDevice:
    device = object.__new__(GenTLDevice)
    device._settings = CameraSettings(driver="gentl", producer="x.cti", serial="1", pixel_format=name)
    device._shape, device._errors, device._refusals = SHAPE, (ProducerError,), (OSError, ProducerError)
    device._nodes = SimpleNamespace(PayloadSize=SimpleNamespace(get_value=lambda *_: payload))
    return device


def buffer_of(name: str, content: bytes, **more: Any) -> Any:
    """A buffer of harvesters."""
    rows, columns = SHAPE
    given = {"width": columns, "height": rows, "pixel_format": pixel_format(name).code, "raw_buffer": content}
    return SimpleNamespace(**{"image_offset": 0, "frame_id": 7, "timestamp_ns": 5, **given, **more})


def counts(name: str) -> np.ndarray:
    depth = pixel_format(name).bit_depth
    return np.random.default_rng(1).integers(0, 2**depth, SHAPE, np.uint8 if depth == 8 else np.uint16)


@pytest.mark.parametrize("name", ["Mono8", "Mono12", "Mono12p"])
@pytest.mark.parametrize("padding", [0, 4])
@pytest.mark.parametrize("offset", [0, 32])
def test_what_surrounds_the_pixels_is_left_out(name: str, padding: int, offset: int) -> None:
    packed = pack(counts(name), name)
    lines = np.pad(packed.reshape(SHAPE[0], -1), ((0, 0), (0, padding)), constant_values=0xA5)
    sent = bytes(offset) + lines.tobytes() + bytes(300)
    with mmap.mmap(-1, packed.size) as memory:
        arrived = device_of(name)._read(buffer_of(name, sent, image_offset=offset, padding_x=padding), memory)
        assert (arrived.fault, arrived.frame_id) == ("", 7)
        assert memory[:] == packed.tobytes()


def test_a_producer_that_tells_no_padding_and_no_offset_has_none() -> None:
    class Buffer(SimpleNamespace):
        @property
        def padding_x(self) -> int:
            raise ProducerError("not available")

        @property
        def image_offset(self) -> int:
            raise ProducerError("not available")

    packed = pack(counts("Mono8"), "Mono8")
    plain = vars(buffer_of("Mono8", packed.tobytes()))
    del plain["image_offset"]
    with mmap.mmap(-1, packed.size) as memory:
        assert device_of()._read(Buffer(**plain), memory).fault == ""
        assert memory[:] == packed.tobytes()


@pytest.mark.parametrize("padding", [0, 4])
def test_too_few_bytes_are_a_fault_of_the_frame(padding: int) -> None:
    packed = pack(counts("Mono8"), "Mono8").tobytes()
    with mmap.mmap(-1, len(packed)) as memory:
        arrived = device_of()._read(buffer_of("Mono8", packed[:-1], padding_x=padding), memory)
        assert f"{len(packed) - 1} bytes" in arrived.fault


def test_a_payload_may_be_larger_and_not_smaller() -> None:
    device_of(payload=96)._check_payload(96)
    device_of(payload=408)._check_payload(96)
    with pytest.raises(CameraRefusedError) as raised:
        device_of(payload=95)._check_payload(96)
    assert (raised.value.setting, raised.value.got, raised.value.expected) == ("PayloadSize", "95", "96 or more")
