"""How large messages are, and chunks of frames.

Chunks of frames are written and read without the copies that protobuf makes of each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb

MESSAGE_BYTES = 4 << 20
"""One message in: chunks stay far below, so that no single message makes the service hold its breath."""

CHUNK_BYTES = 1 << 20
"""Chunk that a client sends: larger ones gain nothing, smaller ones cost calls."""

REPLY_BYTES = 64 << 20
"""One reply: symbols, float32 confidence, concentration and phase of 700 x 450 symbols are 4 MB."""

PIXEL_TYPES = {pb.PIXEL_TYPE_UINT8: "uint8", pb.PIXEL_TYPE_UINT16: "uint16"}
PIXEL_CODES = {name: code for code, name in PIXEL_TYPES.items()}

FramePart: TypeAlias = pb.DecodeFramesRequest | memoryview
"""A message of frames: a chunk of pixels as a view of bytes, anything else as its message."""

_TAG = bytes([pb.DecodeFramesRequest.CHUNK_FIELD_NUMBER << 3 | 2])
"""How a field of bytes with the number of a chunk begins. Source: protobuf's encoding, wire type LEN."""
_LONGEST_VARINT = 5
"""Bytes of a number below 2^35: no message is as large."""


def parsed_part(data: bytes) -> FramePart:
    """A message from the wire.

    Raises:
        google.protobuf.message.DecodeError: it cannot be parsed.
    """
    if data.startswith(_TAG):
        size = 0
        for place, byte in enumerate(data[1 : 1 + _LONGEST_VARINT]):
            size |= (byte & 0x7F) << 7 * place
            if byte < 0x80:
                if (begin := 2 + place) + size == len(data):  # a chunk, and nothing behind it
                    return memoryview(data)[begin:]
                break
    message = pb.DecodeFramesRequest.FromString(data)
    return memoryview(message.chunk) if message.WhichOneof("part") == "chunk" else message


def serialized_part(part: Message | memoryview) -> bytes:
    """A message for the wire."""
    if isinstance(part, memoryview):
        return b"".join((_TAG, _varint(part.nbytes), part))
    return part.SerializeToString()


def chunks_of(frames: Sequence[NDArray[np.integer]]) -> Iterator[memoryview]:
    """The pixels of frames in chunks, little-endian, rows first."""
    for frame in frames:
        data = np.ascontiguousarray(frame, frame.dtype.newbyteorder("<")).view(np.uint8).reshape(-1)
        for start in range(0, data.size, CHUNK_BYTES):
            yield data[start : start + CHUNK_BYTES].data


def _varint(number: int) -> bytes:
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*found, number])
