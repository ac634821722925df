"""What a GenTL producer hands over besides pixels is left out."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lightpage.errors import FrameError
from runtime.cameras.gentl_device import pixel_bytes
from runtime.cameras.pixel_formats import pack, pixel_format

SHAPE = (6, 16)


class UnknownError(Exception):
    """As producers raise it for what they do not know."""


class Buffer(SimpleNamespace):
    """A buffer of harvesters; what it was not given is unknown."""

    def __getattr__(self, name: str) -> object:
        raise UnknownError(name)


def packed(name: str) -> np.ndarray:
    depth = pixel_format(name).bit_depth
    counts = np.random.default_rng(1).integers(0, 2**depth, SHAPE, np.uint8 if depth == 8 else np.uint16)
    return pack(counts, name)


@pytest.mark.parametrize("name", ["Mono8", "Mono12", "Mono12p"])
@pytest.mark.parametrize("padding", [None, 0, 4])
@pytest.mark.parametrize("offset", [None, 32])
def test_what_surrounds_the_pixels_is_left_out(name: str, padding: int | None, offset: int | None) -> None:
    pixels = packed(name)
    lines = np.pad(pixels.reshape(SHAPE[0], -1), ((0, 0), (0, padding or 0)), constant_values=0xA5)
    buffer = Buffer(raw_buffer=bytes(offset or 0) + lines.tobytes() + bytes(300))
    if padding is not None:
        buffer.padding_x = padding
    if offset is not None:
        buffer.image_offset = offset
    assert pixel_bytes(buffer, SHAPE, name, (UnknownError,)) == pixels.tobytes()


@pytest.mark.parametrize("padding", [0, 4])
def test_too_few_bytes_are_a_fault_of_the_frame(padding: int) -> None:
    pixels = packed("Mono8").tobytes()
    with pytest.raises(FrameError, match=str(len(pixels) - 1)):
        pixel_bytes(Buffer(raw_buffer=pixels[:-1], padding_x=padding), SHAPE, "Mono8", (UnknownError,))
