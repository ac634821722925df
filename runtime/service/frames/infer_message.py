"""A ModelInfer message taken apart: its raw contents stay where they are, the rest is parsed."""

from __future__ import annotations

from google.protobuf.message import DecodeError

from lightpage.errors import LimitError, MalformedError
from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip

MOST_FIELDS = 256
"""Of a message, the elements of lists counted one by one: each input, output and parameter is one."""

_SUBJECT = "message of inference/ModelInfer"
_RAW = oip.ModelInferRequest.DESCRIPTOR.fields_by_name["raw_input_contents"].number
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
"""Wire types of protocol buffers."""
_SIZES = {_FIXED64: 8, _FIXED32: 4}
_MOST_VARINT = 10
"""Bytes of one."""


def take_apart(data: bytes, most_beside: int) -> tuple[oip.ModelInferRequest, list[memoryview]]:
    """The request without `raw_input_contents`, and these as views of `data`.

    The library would copy the frames twice. It also takes many times a message's size where that is made of very many
    small parts, so what it parses is bounded.

    Args:
        data: the message.
        most_beside: bytes that it may have beside its raw contents.

    Raises:
        MalformedError: it cannot be parsed.
        LimitError: more fields than make sense, or more bytes.
    """
    view, at = memoryview(data), 0
    raw: list[memoryview] = []
    rest: list[memoryview] = []
    while at < len(data):
        if len(raw) + len(rest) == MOST_FIELDS:
            raise LimitError(_SUBJECT, f"more than {MOST_FIELDS} fields", f"at most {MOST_FIELDS}")
        begun = at
        tag, at = _varint(data, at)
        content, at = _content(data, at, tag & 7)
        if tag >> 3 == _RAW and tag & 7 == _BYTES:
            raw.append(view[content:at])
        else:
            rest.append(view[begun:at])
    if (beside := sum(map(len, rest))) > most_beside:
        expected = f"at most {most_beside}, and raw_input_contents for larger frames"
        raise LimitError(f"{_SUBJECT} beside raw_input_contents", f"{beside} bytes", expected)
    try:
        return oip.ModelInferRequest.FromString(b"".join(rest)), raw
    except DecodeError as error:
        raise _malformed(error) from None


def _content(data: bytes, at: int, kind: int) -> tuple[int, int]:
    """Where the content of a field begins and ends."""
    if kind == _VARINT:
        return at, _varint(data, at)[1]
    if kind == _BYTES:
        size, at = _varint(data, at)
    elif kind in _SIZES:
        size = _SIZES[kind]
    else:
        raise _malformed(f"a field of wire type {kind}")
    if at + size > len(data):
        raise _malformed("a field that ends behind the message")
    return at, at + size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number, and where it ends."""
    value = 0
    for index, byte in enumerate(data[at : at + _MOST_VARINT]):
        value |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return value, at + index + 1
    raise _malformed("a number that does not end")


def _malformed(got: object) -> MalformedError:
    return MalformedError(_SUBJECT, got, "one that can be parsed")
