"""Every count survives every pixel format, and lies in the bytes where the standard says."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lightpage.errors import FrameError, InvalidInputError
from lightpage.runtime.device.cameras.gentl_process import pixel_bytes
from lightpage.runtime.device.cameras.pixel_formats import bit_depth, pixel_format, unpack, without_padding
from lightpage.virtual_device.packing import pack

BYTES = {
    "Mono8": [0x21, 0x43],
    "Mono10": [0x21, 0x03, 0x43, 0x02],
    "Mono12": [0x21, 0x0A, 0x43, 0x0B],
    "Mono14": [0x21, 0x2A, 0x43, 0x3B],
    "Mono16": [0x21, 0xFA, 0x43, 0xEB],
    "Mono10Packed": [0x321 >> 2, (0x321 & 3) | (0x243 & 3) << 4, 0x243 >> 2],
    "Mono12Packed": [0xA2, 0x31, 0xB4],
    "Mono12p": [0x21, 0x3A, 0xB4],
    "Mono10p": [0x21, (0x321 >> 8) | (0x243 & 0x3F) << 2, 0x243 >> 6],
}
"""Two pixels whose counts have the high bits of their place: of 12 bits 0xA21 and 0xB43."""
DEPTHS = {name: int("".join(filter(str.isdigit, name))) for name in BYTES}
FIRST_TWO = {8: (0x21, 0x43), 10: (0x321, 0x243), 12: (0xA21, 0xB43), 14: (0x2A21, 0x3B43), 16: (0xFA21, 0xEB43)}


def kind(depth: int) -> Any:
    return np.uint8 if depth == 8 else np.uint16


@pytest.mark.parametrize("name", DEPTHS)
def test_every_pair_of_neighbours_survives(name: str) -> None:
    """Every value in every place of a group, beside others."""
    depth = DEPTHS[name]
    assert bit_depth(name) == depth
    values = np.arange(2**depth, dtype=kind(depth))
    shuffled = np.random.default_rng(depth).permutation(values)
    frame = np.concatenate([np.roll(values, shift) for shift in range(4)] + [shuffled, values[:64]]).reshape(-1, 64)
    raw = pack(frame, name)
    assert raw.size == pixel_format(name).nbytes(frame.size)
    again = unpack(raw, frame.shape, name)
    assert again.dtype == frame.dtype
    assert again.dtype.isnative
    assert not np.shares_memory(again, raw)
    assert (again == frame).all()


@pytest.mark.parametrize("name", BYTES)
def test_two_pixels_lie_where_the_standard_says(name: str) -> None:
    frame = np.array([FIRST_TWO[DEPTHS[name]]], kind(DEPTHS[name]))
    assert pack(frame, name).tolist() == BYTES[name]
    assert (unpack(np.array(BYTES[name], np.uint8), (1, 2), name) == frame).all()


@pytest.mark.parametrize("pixels", [1, 2, 3, 5, 65_537, 65_539])
@pytest.mark.parametrize("name", ["Mono10p", "Mono12p"])
def test_odd_sizes(name: str, pixels: int) -> None:
    frame = np.random.default_rng(pixels).integers(0, 2 ** DEPTHS[name], (1, pixels), dtype=np.uint16)
    assert (unpack(pack(frame, name), frame.shape, name) == frame).all()


def test_bad_input_is_named() -> None:
    with pytest.raises(InvalidInputError, match="RGB8"):
        bit_depth("RGB8")
    with pytest.raises(FrameError, match="5 bytes"):
        unpack(np.zeros(5, np.uint8), (2, 2), "Mono12p")
    with pytest.raises(FrameError, match="12 bits"):
        pack(np.full((1, 2), 4096, np.uint16), "Mono12p")
    with pytest.raises(FrameError, match="int64"):
        pack(np.zeros((1, 2), np.int64), "Mono8")
    with pytest.raises(FrameError, match="70 bytes"):
        without_padding(np.zeros(70, np.uint8), (5, 16), "Mono8", 4)
    with pytest.raises(FrameError, match="whole bytes"):
        without_padding(np.zeros(1000, np.uint8), (5, 15), "Mono12p", 4)


@pytest.mark.parametrize("name", DEPTHS)
@pytest.mark.parametrize("padding", [0, 1, 60])
def test_padding_is_left_out(name: str, padding: int) -> None:
    frame = np.random.default_rng(2).integers(0, 2 ** DEPTHS[name], (5, 16), dtype=np.uint16)
    frame = frame.astype(kind(DEPTHS[name]))
    lines = pack(frame, name).reshape(5, -1)
    sent = np.concatenate([lines, np.full((5, padding), 0xA5, np.uint8)], axis=1).reshape(-1)
    for raw in (sent, sent[: sent.size - padding], np.append(sent, np.zeros(300, np.uint8))):
        assert (unpack(without_padding(raw, frame.shape, name, padding), frame.shape, name) == frame).all()


@pytest.mark.parametrize("given", [{}, {"padding_x": 4}, {"image_offset": 32}, {"padding_x": 4, "image_offset": 32}])
def test_what_surrounds_the_pixels_is_left_out(given: dict[str, int]) -> None:
    pixels = pack(np.random.default_rng(1).integers(0, 4096, (6, 16), np.uint16), "Mono12p")
    lines = np.pad(pixels.reshape(6, -1), ((0, 0), (0, given.get("padding_x", 0))), constant_values=0xA5)
    content = bytes(given.get("image_offset", 0)) + lines.tobytes()
    for behind in (b"", bytes(300)):
        buffer = SimpleNamespace(raw_buffer=content + behind, **given)
        assert pixel_bytes(buffer, (6, 16), "Mono12p", (AttributeError,)) == pixels.tobytes()


@pytest.mark.parametrize("padding", [0, 4])
def test_too_few_bytes_are_a_fault_of_the_frame(padding: int) -> None:
    with pytest.raises(FrameError, match="95"):
        pixel_bytes(SimpleNamespace(raw_buffer=bytes(95), padding_x=padding), (6, 16), "Mono8", (AttributeError,))
