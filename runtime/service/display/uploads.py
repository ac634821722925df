"""Puts the pages together that a caller sends in messages."""

from __future__ import annotations

from collections.abc import AsyncIterator

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import LimitError, MalformedError, PageError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb


async def uploaded_pages(
    messages: AsyncIterator[pb.UploadPagesRequest], page_shape: tuple[int, int], most_bytes: int
) -> tuple[int, NDArray[np.uint8]]:
    """Level count M and pages [page, ny, nx].

    Args:
        messages: that the caller sends.
        page_shape: symbols as (rows, columns).
        most_bytes: of all pages together.

    Raises:
        MalformedError: messages in the wrong order.
        PageError: parts of pages, or none.
        LimitError: more than the service holds.
    """
    first = await anext(messages, None)
    if first is None or first.WhichOneof("part") != "levels":
        got = "no message" if first is None else first.WhichOneof("part") or "an empty message"
        raise MalformedError("first message of UploadPages", got, "the level count")
    size, parts, held = page_shape[0] * page_shape[1], list[NDArray[np.uint8]](), 0
    async for message in messages:
        if message.WhichOneof("part") != "symbols":
            got = "the level count again" if message.HasField("levels") else "an empty message"
            raise MalformedError("message of UploadPages", got, "pages from there on")
        content = np.frombuffer(message.symbols, np.uint8)
        if not content.size or content.size % size:
            raise PageError("uploaded pages", f"{content.size} symbols", f"whole pages of {size}")
        held += content.size
        if held > most_bytes:
            raise LimitError("uploaded pages", f"at least {held} bytes", f"at most {most_bytes}")
        parts.append(content.reshape(-1, *page_shape))
    if not parts:
        raise PageError("uploaded pages", "none", "at least one")
    return first.levels, np.concatenate(parts)
