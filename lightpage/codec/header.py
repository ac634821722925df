"""The header of a page: which page of which volume it is, and how it is coded; protected by a code of its own.

It can be read before the body, and where the body is lost, so that a lost page has a name. Its CRC-16 alone is not
believed: the body's CRC-32C covers the header's fields too.
"""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.checksum import crc16
from lightpage.codec.ldpc.code import Bits, LdpcCode
from lightpage.codec.ldpc.decoder import decode
from lightpage.codec.mapping import bit_llrs, level_bits, to_levels
from lightpage.codec.page_bytes import VERSION, Header
from lightpage.codec.random_bits import random_bytes
from lightpage.errors import InvalidInputError
from lightpage.page.levels import Levels

MOST_PAGES = 1 << 24
MOST_BYTES = (1 << 40) - 1
"""Largest volume."""
FIELD_BYTES = 15
HEADER_BYTES = FIELD_BYTES + 2
_SENT_BITS, _SENT_BITS_OF_FEW_LEVELS = 204, 408
"""Two thirds of them information, on levels three bits coarser than the body's: far below what the page carries. Of few
levels none are so much coarser, and one third are."""
_FEW_LEVELS = 4
_COARSER = 8
_SCRAMBLER_SEED = 0x4C50_4844


def parse_header(data: bytes) -> Header | None:
    """The header in 17 bytes; None where its CRC-16 does not hold or its version is another."""
    fields = data[:FIELD_BYTES]
    if crc16(fields) != int.from_bytes(data[FIELD_BYTES:HEADER_BYTES], "big"):
        return None
    version, code_id, volume = struct.unpack(">BHI", fields[:7])
    if version != VERSION:
        return None
    page, volume_bytes = int.from_bytes(fields[7:10], "big"), int.from_bytes(fields[10:], "big")
    return Header(code_id, volume, page, volume_bytes, version)


def check_volume(volume: int, volume_bytes: int, pages: int) -> None:
    """Check that a volume can be numbered.

    Raises:
        InvalidInputError: its number, size or count of pages does not fit the header.
    """
    if not 0 <= volume < 1 << 32:
        raise InvalidInputError("volume id", volume, f"0 to {(1 << 32) - 1}")
    if not 0 <= volume_bytes <= MOST_BYTES:
        raise InvalidInputError("file", f"{volume_bytes} bytes", f"0 to {MOST_BYTES} in a volume")
    if pages > MOST_PAGES:
        raise InvalidInputError("file", f"{pages} pages", f"at most {MOST_PAGES} in a volume")


def sent_bits(levels: int) -> int:
    """Bits of the header's block on a page of M levels."""
    return _SENT_BITS_OF_FEW_LEVELS if levels <= _FEW_LEVELS else _SENT_BITS


@lru_cache(2)
def _code(sent: int) -> LdpcCode:
    return LdpcCode(8 * HEADER_BYTES, sent)


def header_levels(levels: int) -> int:
    """Levels that the header is written with on a page of M levels: every eighth of them, or two opposite ones."""
    return max(2, levels // _COARSER)


def header_symbols(levels: int) -> int:
    """Symbols of a header on a page of M levels."""
    return -(-sent_bits(levels) // level_bits(header_levels(levels)))


def encode_headers(headers: list[Header], levels: int) -> NDArray[np.uint8]:
    """The symbols of headers, uint8 [headers, header symbols].

    Args:
        headers: headers of the pages.
        levels: M of the page.
    """
    text = np.array([np.frombuffer(header.to_bytes(), np.uint8) for header in headers])
    text ^= random_bytes(_SCRAMBLER_SEED, HEADER_BYTES)
    sent = _code(sent_bits(levels)).encode(np.unpackbits(text, axis=1))
    coarse, bits = header_levels(levels), level_bits(header_levels(levels))
    padded = np.zeros((len(headers), header_symbols(levels) * bits), np.uint8)
    padded[:, : sent.shape[1]] = sent
    label: Bits = padded.reshape(-1, bits)
    symbols = to_levels(label, np.zeros(len(label), np.int64), coarse).astype(np.int64) * (levels // coarse)
    return symbols.astype(np.uint8).reshape(len(headers), -1)


def decode_header(
    phase: NDArray[np.floating], concentration: NDArray[np.floating], levels: int | Levels
) -> Header | None:
    """The header in its symbols' phases (radians) and concentrations; None where it cannot be read."""
    levels = Levels.of(levels)
    coarse, sent = levels.every(levels.count // header_levels(levels.count)), sent_bits(levels.count)
    found = decode(_code(sent), bit_llrs(phase, concentration, coarse).reshape(1, -1)[:, :sent])
    if not found.converged[0]:
        return None
    text = np.packbits(found.information[0]) ^ random_bytes(_SCRAMBLER_SEED, HEADER_BYTES)
    return parse_header(text.tobytes())
