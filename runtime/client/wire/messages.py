"""Messages made of objects, and dataclasses made of messages: a field goes by its name, so nobody copies it by hand.

A value is written and read by what its field is declared to be:

| in Python | in a message |
|---|---|
| an array of floats, of symbols, of truth values | bytes: little-endian float32, or a byte each; or a repeated field |
| a member of an enumeration, or its name as a text | a number, named as the member with the enumeration's prefix |
| a dataclass | a message |
| a tuple, a dict | a repeated field, a map |
| None | a field that is not set; one without presence that is zero or empty, where the dataclass allows None |

Chunks of frames are written and read without the copies that protobuf makes of each.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.message import Message
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError, LightpageError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb

MESSAGE_BYTES = 4 << 20
"""One message in: chunks stay far below, so that no single message makes the service hold its breath."""

CHUNK_BYTES = 1 << 20
"""Chunk that a client sends: larger ones gain nothing, smaller ones cost calls."""

REPLY_BYTES = 64 << 20
"""One reply: symbols, float32 confidence, concentration and phase of 700 x 450 symbols are 4 MB."""

PIXEL_TYPES = {pb.PIXEL_TYPE_UINT8: "uint8", pb.PIXEL_TYPE_UINT16: "uint16"}

FLOAT = np.dtype("<f4")
"""Of confidences, concentrations and phases."""

FramePart: TypeAlias = pb.DecodeFramesRequest | memoryview
"""A message of frames: a chunk of pixels as a view of bytes, anything else as its message."""

_TAG = bytes([pb.DecodeFramesRequest.CHUNK_FIELD_NUMBER << 3 | 2])
"""How a field of bytes with the number of a chunk begins. Source: protobuf's encoding, wire type LEN."""
_LONGEST_VARINT = 5
"""Bytes of a number below 2^35: no message is as large."""

D = TypeVar("D")
E = TypeVar("E", bound=Enum)
M = TypeVar("M", bound=Message)


def message_of(kind: Callable[..., M], *sources: object, **given: object) -> M:
    """Make a message of the fields `given`; with sources, any other field is the first source's attribute of its name.

    Raises:
        InvalidInputError: given a value that no message can hold, for instance a number out of range.
        TypeError: no source has a field: each is to be given, if only as None. Or an array is of another type.
        ValueError: a source has a value that no message can hold.
    """
    found = _fields(kind.DESCRIPTOR, sources, given)  # type: ignore[attr-defined]  # a class of messages has it
    try:
        return kind(**found)
    except (ValueError, TypeError):
        for name, value in () if sources else found.items():  # what the objects of a program say is no one's input
            try:
                kind(**{name: value})
            except (ValueError, TypeError) as error:
                expected = f"what the field {name} of {kind.__name__} can hold ({error})"
                raise InvalidInputError(name, repr(given.get(name, value))[:100], expected) from None
        raise


def answer_of(kind: Callable[..., D], *messages: Message, shape: tuple[int, int] | None = None, **given: object) -> D:
    """Make a dataclass of the fields `given`; any other is the first message's that has one of its name.

    Args:
        kind: the dataclass; its annotations say what becomes of a field.
        messages: messages with its fields. A field of the dataclass that is in none has its default.
        shape: (rows, columns) of the arrays in them.
        given: fields.

    Raises:
        LightpageError: an array whose size contradicts the shape.
    """
    for name, hint in _hints(kind).items():
        message = next((each for each in messages if name in each.DESCRIPTOR.fields_by_name), None)
        if name not in given and message is not None:
            given[name] = _read(message, name, hint, shape)
    return kind(**given)


def array_of(data: bytes, dtype: np.dtype[Any], shape: tuple[int, int], name: str) -> NDArray[Any]:
    """Return an array [row, column] of the bytes of a reply's field.

    Raises:
        LightpageError: they are too few or too many.
    """
    if len(data) != shape[0] * shape[1] * dtype.itemsize:
        raise LightpageError(f"reply: {name}", f"{len(data)} bytes", f"{shape[0]}x{shape[1]} of {dtype}")
    return np.frombuffer(data, dtype).reshape(shape)


def enum_name(enum: EnumDescriptor, number: int, otherwise: str = "") -> str:
    """Return the name of a number without the enumeration's prefix; `otherwise` of one that this version has not."""
    known = enum.values_by_number.get(number)
    return otherwise if known is None else known.name.removeprefix(_prefix(enum))


def member_of(kind: type[E], enum: EnumDescriptor, number: int, otherwise: E) -> E:
    """Return the member that a number stands for; `otherwise` for one that `kind` does not have."""
    return kind.__members__.get(enum_name(enum, number), otherwise)


def _fields(kind: Descriptor, sources: tuple[object, ...], given: Mapping[str, object]) -> dict[str, Any]:
    """The fields of a message as its constructor takes them."""
    found = dict(given)
    for name in kind.fields_by_name if sources else ():
        if name not in given:
            source = next((each for each in sources if hasattr(each, name)), None)
            if source is None:
                raise TypeError(f"{kind.name}.{name} is an attribute of none of {[type(each) for each in sources]}")
            found[name] = getattr(source, name)
    return {name: _written(kind.fields_by_name.get(name), value) for name, value in found.items() if value is not None}


def _written(told: FieldDescriptor | None, value: Any) -> Any:
    """A value as the constructor of a message takes it."""
    if told is None:  # the constructor says that there is no such field
        return value
    if isinstance(value, np.ndarray) and told.is_repeated:
        return value.tolist()
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return value.astype(FLOAT, copy=False).tobytes()
    if isinstance(value, np.ndarray):
        return value.astype(np.uint8, casting="safe", copy=False).tobytes()
    if isinstance(value, Mapping) or not told.is_repeated:
        return _one_written(told, value)
    return [_one_written(told, each) for each in value]


def _one_written(told: FieldDescriptor, value: Any) -> Any:
    if told.enum_type is not None and isinstance(value, str):
        return _prefix(told.enum_type) + (value.name if isinstance(value, Enum) else value.upper())
    if told.message_type is not None and not isinstance(value, Message | Mapping):
        return _fields(told.message_type, (value,), {})
    return value


def _read(message: Message, name: str, hint: Any, shape: tuple[int, int] | None) -> Any:
    """The value of a field as a dataclass has it."""
    told: Any = message.DESCRIPTOR.fields_by_name[name]
    value, kind = getattr(message, name), hint
    if isinstance(hint, UnionType):
        if not (message.HasField(name) if told.has_presence else value):
            return None
        kind = next(each for each in get_args(hint) if each is not NoneType)
    outer, inner = get_origin(kind), get_args(kind)
    if outer is np.ndarray:
        (scalar,) = get_args(inner[1])
        wire = FLOAT if scalar is np.float32 else np.dtype(np.uint8)
        array = np.array(value) if shape is None or told.is_repeated else array_of(value, wire, shape, name)
        return array.astype(scalar, copy=False)
    if outer is tuple:
        return tuple(_one_read(told, each, inner[0]) for each in value)
    return dict(value) if outer is dict else _one_read(told, value, kind)


def _one_read(told: FieldDescriptor, value: Any, kind: Any) -> Any:
    if told.enum_type is not None:
        name = enum_name(told.enum_type, value, "OTHER")
        return name if kind is str else kind.__members__.get(name, kind.UNKNOWN)
    return value if told.message_type is None else answer_of(kind, value)


@cache
def _hints(kind: Callable[..., Any]) -> dict[str, Any]:
    """The fields of a dataclass with their types."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}  # type: ignore[arg-type]


def _prefix(enum: EnumDescriptor) -> str:
    """Return what all names of an enumeration begin with, as that of its zero does."""
    return enum.values_by_number[0].name.removesuffix("UNSPECIFIED")


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
