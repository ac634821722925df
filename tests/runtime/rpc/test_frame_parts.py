"""Chunks of frames are written and read as protobuf does, without its copies."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf.message import DecodeError

from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.wire.frame_parts import chunks_of, parsed_part, serialized_part
from runtime.wire.sizes import CHUNK_BYTES


@pytest.mark.parametrize("size", [0, 1, 127, 128, 16_383, 16_384, 1 << 20, (1 << 21) + 5])
def test_a_chunk_is_written_and_read_as_protobuf_does(size: int) -> None:
    chunk = np.random.default_rng(size).integers(0, 256, size, np.uint8).tobytes()
    message = pb.DecodeFramesRequest(chunk=chunk).SerializeToString()
    assert serialized_part(memoryview(chunk)) == message
    assert parsed_part(message) == chunk
    assert pb.DecodeFramesRequest.FromString(message).chunk == chunk


def test_a_chunk_is_read_without_a_copy() -> None:
    message = pb.DecodeFramesRequest(chunk=bytes(1000)).SerializeToString()
    part = parsed_part(message)
    assert isinstance(part, memoryview)
    assert part.obj is message


def test_a_header_stays_a_message() -> None:
    header = pb.DecodeFramesRequest(header=pb.DecodeHeader(rows_px=3, correlation_id="x"))
    assert parsed_part(header.SerializeToString()) == header
    assert parsed_part(b"") == pb.DecodeFramesRequest()


def test_what_is_written_otherwise_is_read_as_protobuf_reads_it() -> None:
    chunk, other = pb.DecodeFramesRequest(chunk=b"abc").SerializeToString(), b"\xf8\x07\x01"  # an unknown field
    assert parsed_part(chunk + other) == b"abc"
    assert parsed_part(other + chunk) == b"abc"
    assert parsed_part(chunk + pb.DecodeFramesRequest(chunk=b"de").SerializeToString()) == b"de"
    assert parsed_part(b"\x12\x83\x00abc") == b"abc"  # a longer number than need be


@pytest.mark.parametrize("data", [b"\x12", b"\x12\x05abc", b"\x12\xff\xff\xff\xff\xff\xff", b"\x12\x80", b"\x0f"])
def test_what_cannot_be_parsed_is_refused(data: bytes) -> None:
    with pytest.raises(DecodeError):
        parsed_part(data)


def test_frames_are_cut_little_endian() -> None:
    frame = np.arange(CHUNK_BYTES, dtype=">u2").reshape(4, -1)
    chunks = list(chunks_of([frame, frame[:1].T]))
    assert [chunk.nbytes for chunk in chunks] == [CHUNK_BYTES, CHUNK_BYTES, CHUNK_BYTES // 2]
    assert b"".join(chunks[:2]) == frame.astype("<u2").tobytes()
