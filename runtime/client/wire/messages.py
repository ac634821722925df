"""Parts of messages that both ends write and read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import TypeVar

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from lightpage.codec.page_bytes import FileFacts, Header, Loss, PageBytes
from lightpage.errors import InvalidInputError, PageError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.model.decoding.image_position import ImagePosition

PIXEL_TYPES = {pb.PIXEL_TYPE_UINT8: "uint8", pb.PIXEL_TYPE_UINT16: "uint16"}
PIXEL_CODES = {name: code for code, name in PIXEL_TYPES.items()}

DATA_LOSSES: dict[Loss | None, pb.DataLoss] = {
    None: pb.DATA_LOSS_UNSPECIFIED,
    Loss.OPTICS: pb.DATA_LOSS_OPTICS,
    Loss.HEADER: pb.DATA_LOSS_HEADER,
    Loss.CODE: pb.DATA_LOSS_CODE,
    Loss.BODY: pb.DATA_LOSS_BODY,
    Loss.CHECKSUM: pb.DATA_LOSS_CHECKSUM,
}
FLOAT = np.dtype("<f4")
"""Of confidences, concentrations and phases."""


M = TypeVar("M", bound=Message)


def message_of(kind: Callable[..., M], **fields: object) -> M:
    """A message with these fields; None stands for one that is not set.

    Raises:
        InvalidInputError: one that no message can hold, for instance a number out of range.
    """
    message = kind()
    set_fields(message, **fields)
    return message


def set_fields(message: Message, **fields: object) -> None:
    """Set fields of a message; raises as `message_of`."""
    for name, value in fields.items():
        try:
            message.MergeFrom(type(message)(**{name: value}))
        except (ValueError, TypeError) as error:
            expected = f"what the field {name} of {message.DESCRIPTOR.name} can hold ({error})"
            raise InvalidInputError(name, repr(value)[:100], expected) from None


def pixel_type(code: pb.PixelType) -> str:
    """numpy's name of a pixel type.

    Raises:
        InvalidInputError: unspecified or unknown.
    """
    if code not in PIXEL_TYPES:
        raise InvalidInputError("pixel_type", code, "PIXEL_TYPE_UINT8 or PIXEL_TYPE_UINT16")
    return PIXEL_TYPES[code]


@dataclass(frozen=True)
class KnownPilots:
    """Pilots that a caller knows: bool mask [ny, nx], a page of symbols [ny, nx], and their level count."""

    mask: NDArray[np.bool_]
    symbols: NDArray[np.uint8]
    levels: int


def pilots_message(pilots: KnownPilots) -> pb.Pilots:
    """Pilots as their message.

    Raises:
        PageError: mask and page differ in shape.
    """
    if pilots.mask.shape != pilots.symbols.shape:
        raise PageError("pilots", f"mask {pilots.mask.shape}, page {pilots.symbols.shape}", "two equal shapes")
    values = pilots.symbols[pilots.mask].tobytes()
    return pb.Pilots(mask=pilots.mask.astype(np.uint8).tobytes(), values=values, levels=pilots.levels)


def user_data_of(message: pb.UserData) -> PageBytes:
    """A message as what a page gave; a loss that this version does not know counts as one of the body."""
    told = message.header
    header = Header(told.code_id, told.volume, told.page, told.volume_bytes) if message.HasField("header") else None
    loss = next((loss for loss, known in DATA_LOSSES.items() if known == message.loss), Loss.BODY)
    return PageBytes(
        header,
        message.data if loss is None else None,
        FileFacts(message.data_pages, message.parity_pages, message.file_checksum) if loss is None else None,
        loss,
        message.iterations,
        message.failed_blocks,
        message.blocks,
        message.corrected,
        message.margin_bits,
    )


def image_message(image: ImagePosition) -> pb.ImagePosition:
    """An image's position as its message."""
    return pb.ImagePosition(**asdict(image))


def image_of(message: pb.ImagePosition) -> ImagePosition:
    """A message as an image's position."""
    return ImagePosition(**{field.name: getattr(message, field.name) for field in fields(ImagePosition)})
