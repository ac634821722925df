"""Requests of a caller: options of a page, and the messages of its frames and symbols."""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError, InvalidInputError, PageError
from lightpage.page.levels import MAX_LEVELS
from lightpage.recording.frame_pair import FramePair, check_pair
from lightpage.runtime.client.connection import Connection
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import PIXEL_TYPES, message_of


class PageOptions(TypedDict, total=False):
    """Options of a page: the parts that the caller wants, and the session that it belongs to. All may be left out.

    Attributes:
        want_concentration: also get kappa.
        want_phase: also get the phase.
        quantised: get the confidence in one byte a symbol.
        user_data: also get the page's bytes; the level count must then be that of the model's code, or 0.
        session: of the pages that this one is followed with; by default those of the connection, at a Unix socket those
            of the client, or of the device where the service reads the page.
        stateless: decode the page as if it were the first, so that the same frames give the same answer.
        least_steps: fewest Gauss-Newton steps of the page, where the time until the deadline is too short for all; by
            default all steps of the model.
        correlation_id: a text that the page and the log have.
    """

    want_concentration: bool
    want_phase: bool
    quantised: bool
    user_data: bool
    session: str
    stateless: bool
    least_steps: int
    correlation_id: str


@dataclass(frozen=True)
class KnownPilots:
    """Pilots that a caller knows: bool mask [ny, nx], a page of symbols [ny, nx], and their level count."""

    mask: NDArray[np.bool_]
    symbols: NDArray[np.uint8]
    levels: int


class FrameOptions(PageOptions, total=False):
    """Facts of frames, beside the options of their page. All may be left out.

    Attributes:
        bit_depth: bits of a camera count; by default those of the service's camera.
        black_level: counts that the cameras add to every pixel.
        pilots: known symbols, where they differ from the device's pilots.
    """

    bit_depth: int | None
    black_level: int
    pilots: KnownPilots | None


def options_message(levels: int, options: Mapping[str, Any]) -> pb.DecodeOptions:
    """Return `PageOptions` but for the correlation id, which is no part of it; `levels` 0 stands for the default.

    Raises:
        InvalidInputError: values that no message can hold, or an option that there is not.
    """
    for name in options.keys() - PageOptions.__annotations__.keys():
        close = get_close_matches(name, PageOptions.__annotations__, 1) or sorted(PageOptions.__annotations__)
        raise InvalidInputError("option of a page", name, " or ".join(close))
    asked = {name: value for name, value in options.items() if name != "correlation_id"}
    quantised, stateless = asked.pop("quantised", False), asked.pop("stateless", False)
    return message_of(
        pb.DecodeOptions,
        levels=levels,
        confidence_format="UINT8" if quantised else "FLOAT32",
        want_user_data=asked.pop("user_data", False),
        tracking="STATELESS" if stateless else "SESSION",
        **asked,
    )


def format_of(frame: NDArray[np.integer]) -> dict[str, Any]:
    """Return what a header says of the size and the type of frames."""
    return {"rows_px": frame.shape[0], "columns_px": frame.shape[1], "pixel_type": frame.dtype.name}


def header_message(
    connection: Connection, frame: NDArray[np.integer], levels: int, options: FrameOptions, **own: object
) -> pb.DecodeHeader:
    """Return what is sent before a pair, with what is the caller's `own` of it.

    Raises:
        PageError: mask and page of the pilots differ in shape.
        InvalidInputError: see `options_message`.
    """
    asked: dict[str, Any] = dict(options)
    bit_depth, pilots = asked.pop("bit_depth", None), asked.pop("pilots", None)
    own |= {"black_level": asked.pop("black_level", None), "correlation_id": asked.get("correlation_id")}
    page = options_message(levels, asked)
    if page.tracking != pb.TRACKING_STATELESS:
        page.session = page.session or connection.session
    if bit_depth is None:
        bit_depth = connection.description.bit_depth
    if pilots is not None:
        if pilots.mask.shape != pilots.symbols.shape:
            raise PageError("pilots", f"mask {pilots.mask.shape}, page {pilots.symbols.shape}", "two equal shapes")
        pilots = message_of(pb.Pilots, pilots, values=sent_symbols(pilots.symbols[pilots.mask], "pilots"))
    return message_of(pb.DecodeHeader, **format_of(frame), bit_depth=bit_depth, options=page, pilots=pilots, **own)


def sent_frames(
    pair: FramePair, subject: str = "", like: NDArray[np.integer] | None = None
) -> list[NDArray[np.integer]]:
    """Return both frames, in-phase first, which are to have the size and type of another one, `like`.

    Raises:
        FrameError: they cannot be sent.
    """
    check_pair(pair, subject)
    frames = [np.asarray(pair.in_phase), np.asarray(pair.quadrature)]
    first = frames[0] if like is None else like
    for name, frame in zip(("in-phase frame", "quadrature frame"), frames, strict=True):
        alike = (frame.shape, frame.dtype) == (first.shape, first.dtype)
        if frame.dtype.name not in PIXEL_TYPES.values() or frame.ndim != 2 or not alike:
            got, expected = f"{frame.dtype} {frame.shape}", "uint8 or uint16, rows and columns, as the others"
            raise FrameError(subject + name, got, expected)
    return frames


def sent_symbols(page: NDArray[np.uint8], subject: str) -> bytes:
    """Return a page of symbols, a byte each.

    Raises:
        PageError: they do not fit into bytes.
    """
    symbols = np.asarray(page)
    if symbols.dtype.kind not in "ui" or (
        symbols.size and not 0 <= int(symbols.min()) <= int(symbols.max()) < MAX_LEVELS
    ):
        raise PageError(subject, f"{symbols.dtype}", f"whole numbers from 0 to {MAX_LEVELS - 1}")
    return symbols.astype(np.uint8).tobytes()
