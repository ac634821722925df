"""Pixels as cameras send them: how GenICam's monochrome formats lie in memory.

Names and codes are the EMVA's (Pixel Format Naming Convention). `Mono10p` and `Mono12p` fill bits from the lowest
one up. `Mono10Packed` and `Mono12Packed` are GigE Vision's older packings: two pixels in three bytes, high bits in the
first and the last one, the low bits of both between them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError, InvalidInputError

Counts = NDArray[np.unsignedinteger[Any]]
_Words = NDArray[np.uint64]

_GROUP = 4
"""Pixels that are unpacked together, in one 64-bit word, 16 bits for each."""
_BLOCK = 1 << 13
"""Groups at a time: what is worked on stays in the processor's cache."""


@dataclass(frozen=True)
class PixelFormat:
    """A format.

    Attributes:
        name: as GenICam has it.
        code: code of the format on the wire.
        bit_depth: bits of a count.
        group_bytes: bytes of four pixels.
        spread: four packed pixels in the low bits of each word to 16 bits for each; None where they lie so already.
    """

    name: str
    code: int
    bit_depth: int
    group_bytes: int
    spread: Callable[[_Words], _Words] | None = None

    def nbytes(self, pixels: int) -> int:
        """Bytes of so many pixels."""
        return -(-pixels * self.group_bytes // _GROUP)


def _spread_p(bits: int) -> Callable[[_Words], _Words]:
    """Return what spreads the pixels of GenICam's packing, which leaves no gaps between them."""
    pair, first = (1 << 2 * bits) - 1, (1 << bits) - 1
    pairs_low, pairs_high = np.uint64(pair), np.uint64(pair << 2 * bits)
    firsts, seconds = np.uint64(first | first << 32), np.uint64((first | first << 32) << bits)

    def spread(word: _Words) -> _Words:
        pairs = word & pairs_low | (word & pairs_high) << np.uint64(32 - 2 * bits)
        lanes: _Words = pairs & firsts | (pairs & seconds) << np.uint64(16 - bits)
        return lanes

    return spread


def _spread_packed(low_bits: int) -> Callable[[_Words], _Words]:
    """Return pixels from GigE Vision's packing, with two or four low bits of each pixel in the middle byte."""
    low = (1 << low_bits) - 1
    first, second = np.uint64(low << 8 | low << 40), np.uint64(low << 12 | low << 44)
    high, up = np.uint64(0x00FF00FF00FF00FF), np.uint64(low_bits)

    def spread(word: _Words) -> _Words:
        pairs = word & np.uint64(0xFFFFFF) | (word & np.uint64(0xFFFFFF000000)) << np.uint64(8)
        lanes: _Words = (pairs & high) << up | (pairs & first) >> np.uint64(8) | (pairs & second) << np.uint64(4)
        return lanes

    return spread


FORMATS = {
    known.name: known
    for known in (
        PixelFormat("Mono8", 0x01080001, 8, 4),
        PixelFormat("Mono10", 0x01100003, 10, 8),
        PixelFormat("Mono12", 0x01100005, 12, 8),
        PixelFormat("Mono14", 0x01100025, 14, 8),
        PixelFormat("Mono16", 0x01100007, 16, 8),
        PixelFormat("Mono10Packed", 0x010C0004, 10, 6, _spread_packed(2)),
        PixelFormat("Mono12Packed", 0x010C0006, 12, 6, _spread_packed(4)),
        PixelFormat("Mono10p", 0x010A0046, 10, 5, _spread_p(10)),
        PixelFormat("Mono12p", 0x010C0047, 12, 6, _spread_p(12)),
    )
}


def pixel_format(name: str) -> PixelFormat:
    """The format of this name.

    Raises:
        InvalidInputError: there is none that this program reads.
    """
    if name not in FORMATS:
        raise InvalidInputError("pixel format", repr(name), ", ".join(FORMATS))
    return FORMATS[name]


def bit_depth(name: str) -> int:
    """Bits of a count in this pixel format.

    Raises:
        InvalidInputError: see `pixel_format`.
    """
    return pixel_format(name).bit_depth


def without_padding(raw: NDArray[np.uint8], shape: tuple[int, int], name: str, padding: int) -> NDArray[np.uint8]:
    """The bytes of a frame whose lines have `padding` bytes behind their pixels, without these.

    Args:
        raw: bytes of one frame; the last line need not be padded.
        shape: (rows, columns).
        name: name of the pixel format.
        padding: bytes behind each line.

    Raises:
        InvalidInputError: see `pixel_format`.
        FrameError: too few bytes, or lines that do not end with a byte.
    """
    if not padding:
        return raw
    known, (rows, columns) = pixel_format(name), shape
    line = known.nbytes(columns)
    size = rows * (line + padding) - padding
    if raw.size < size or rows * line != known.nbytes(rows * columns):
        expected = f"{size} of {rows} lines of {columns} pixels, each of whole bytes and {padding} more"
        raise FrameError(f"frame in {name}", f"{raw.size} bytes", expected)
    raw = np.ascontiguousarray(raw[:size])
    return np.ndarray((rows, line), np.uint8, raw, strides=(line + padding, 1)).reshape(-1)


def unpack(raw: NDArray[np.uint8], shape: tuple[int, int], name: str) -> Counts:
    """Counts from what a camera sent, always a copy.

    Args:
        raw: bytes of one frame; what follows its pixels is left out.
        shape: (rows, columns).
        name: name of the pixel format.

    Returns:
        [row, column], uint8 or uint16 in native byte order, right-aligned.

    Raises:
        InvalidInputError: see `pixel_format`.
        FrameError: too few bytes.
    """
    known = pixel_format(name)
    pixels = shape[0] * shape[1]
    size = known.nbytes(pixels)
    if raw.size < size:
        raise FrameError(f"frame in {name}", f"{raw.size} bytes", f"{size} of {shape[0]} x {shape[1]} pixels")
    raw = raw[:size]
    if known.spread is not None:
        counts: Counts = _unpack_words(raw, pixels, known.group_bytes, known.spread)
    elif known.bit_depth == 8:
        counts = raw.copy()
    else:
        counts = np.frombuffer(np.ascontiguousarray(raw), "<u2").astype(np.uint16)
    return counts.reshape(shape)


def _unpack_words(
    raw: NDArray[np.uint8], pixels: int, group_bytes: int, spread: Callable[[_Words], _Words]
) -> NDArray[np.uint16]:
    """A 64-bit word is laid over every group of four pixels, which overlap, and shifted apart in it."""
    groups = -(-pixels // _GROUP)
    words = np.empty(groups, "<u8")
    block = np.zeros(_BLOCK * group_bytes + 8, np.uint8)
    over = np.ndarray(_BLOCK, "<u8", block, strides=(group_bytes,))
    for start in range(0, groups, _BLOCK):
        count = min(_BLOCK, groups - start)
        part = raw[start * group_bytes : (start + count) * group_bytes]
        block[: part.size] = part
        words[start : start + count] = spread(over[:count].astype(np.uint64))
    return words.view("<u2")[:pixels].astype(np.uint16, copy=False)
