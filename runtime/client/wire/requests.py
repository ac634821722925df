"""What the service reads of a request and checks before it does anything, and parts of its answers."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from lightpage.errors import InvalidInputError, PageError
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import check_levels, symbol_phases
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import PIXEL_TYPES
from lightpage.runtime.model.decoding.image_position import ImagePosition

_CONFIDENCE_FORMATS = (pb.CONFIDENCE_FORMAT_UNSPECIFIED, pb.CONFIDENCE_FORMAT_FLOAT32, pb.CONFIDENCE_FORMAT_UINT8)

SESSION_CHARACTERS = 1024
"""Of the name of a session, at most: the service remembers it."""


def pilots_of(message: pb.Pilots, page_shape: tuple[int, int], levels: int) -> Pilots:
    """Pilots that a caller sent.

    Raises:
        PageError: sizes that do not fit the page, or levels out of range.
    """
    flags = np.frombuffer(message.mask, np.uint8)
    values = np.frombuffer(message.values, np.uint8)
    if flags.size and int(flags.max()) > 1:
        raise PageError("pilots", f"a flag of {flags.max()}", "flags of 0 or 1")
    if flags.size != page_shape[0] * page_shape[1] or np.count_nonzero(flags) != values.size:
        got = f"{flags.size} flags, {np.count_nonzero(flags)} of them set, and {values.size} values"
        raise PageError("pilots", got, f"{page_shape[0] * page_shape[1]} flags and one value a set flag")
    if message.levels:
        check_levels(message.levels)
    levels = message.levels or levels
    if values.size and int(values.max()) >= levels:
        raise PageError("pilots", f"level {values.max()}", f"0..{levels - 1}")
    return Pilots(flags.reshape(page_shape) != 0, symbol_phases(values, levels))


def check_options(options: pb.DecodeOptions) -> None:
    """Check what a caller asks for, before a frame is received or a page is read for it.

    Raises:
        PageError: an impossible level count; 0 stands for the default.
        InvalidInputError: an unknown format of confidences, or way of tracking, or too long a name of a session.
    """
    if options.levels:
        check_levels(options.levels)
    if options.confidence_format not in _CONFIDENCE_FORMATS:
        expected = "CONFIDENCE_FORMAT_FLOAT32 or CONFIDENCE_FORMAT_UINT8"
        raise InvalidInputError("confidence_format", options.confidence_format, expected)
    if options.tracking not in pb.Tracking.values():
        raise InvalidInputError("tracking", options.tracking, "TRACKING_SESSION or TRACKING_STATELESS")
    if (length := len(options.session)) > SESSION_CHARACTERS:
        raise InvalidInputError("session", f"{length} characters", f"at most {SESSION_CHARACTERS}")


def pixel_type(code: pb.PixelType) -> str:
    """numpy's name of a pixel type.

    Raises:
        InvalidInputError: unspecified or unknown.
    """
    if code not in PIXEL_TYPES:
        raise InvalidInputError("pixel_type", code, "PIXEL_TYPE_UINT8 or PIXEL_TYPE_UINT16")
    return PIXEL_TYPES[code]


def image_message(image: ImagePosition) -> pb.ImagePosition:
    """An image's position as its message."""
    return pb.ImagePosition(**asdict(image))
