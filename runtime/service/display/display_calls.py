"""The controller's side of the modulator: UploadPages, WatchDisplay, ReportDisplay."""

import asyncio
from collections.abc import AsyncIterator

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError, LimitError, MalformedError, NoSourceError, PageError, StalledError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.acquisition.source import FrameSource
from lightpage.runtime.device.modulator.external import ExternalBeams, ExternalModulator
from lightpage.runtime.device.modulator.modulator import BeamState
from lightpage.runtime.service.caller import Call, Role
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.rpc import rpc

_POLL_S = 0.02
"""How often is looked for something new to show."""


class DisplayCalls:
    """Handlers of the calls about what is shown.

    Args:
        plane: has the source whose pages, modulator and beams a controller works.
    """

    def __init__(self, plane: DataPlane) -> None:
        self._plane = plane

    @rpc(Role.DECODE, is_upload=True)
    async def UploadPages(self, requests: AsyncIterator[pb.UploadPagesRequest], call: Call) -> pb.UploadPagesReply:
        """Receive pages to show."""
        limits, shape = self._plane.limits, self._plane.models.current.decoder.bundle.profile.page_shape
        try:
            async with asyncio.timeout(limits.receive_s):
                levels, symbols = await uploaded_pages(requests, shape, limits.uploaded_bytes)
        except TimeoutError:
            late = f"not all of them within {limits.receive_s:g} s"
            raise StalledError("uploaded pages", late, "faster pages") from None
        first = await call.in_thread(lambda: self._added(symbols, levels))
        return pb.UploadPagesReply(first_page=first, pages=len(symbols))

    @rpc(Role.DECODE, is_watch=True)
    async def WatchDisplay(self, request: pb.WatchDisplayRequest, call: Call) -> AsyncIterator[pb.WatchDisplayReply]:
        """Tell a controller what to show."""
        with self._plane.watches.held_at_once():
            last, source = None, self._plane.source
            while True:
                if (wanted := _wanted(source)) != last:
                    last = wanted
                    yield wanted
                await asyncio.sleep(_POLL_S)

    @rpc(Role.DECODE)
    def ReportDisplay(self, request: pb.ReportDisplayRequest, call: Call) -> pb.ReportDisplayReply:
        """Hear from a controller what is shown."""
        kind, source = request.WhichOneof("what"), self._plane.source
        modulator, beams = source.modulator, source.beams
        if kind is None:
            raise InvalidInputError("report of the display", "nothing", "a page, its end, or beams")
        if kind == "beams":
            if not isinstance(beams, ExternalBeams):
                raise _alone(source)
            beams.announce(BeamState(request.beams.signal, request.beams.reference))
        elif not isinstance(modulator, ExternalModulator):
            raise _alone(source)
        else:
            modulator.announce(request.page if kind == "page" else None)
        return pb.ReportDisplayReply()

    def _added(self, symbols: NDArray[np.uint8], levels: int) -> int:
        """Have the source show pages [page, ny, nx] of M levels too; returns the first one's number.

        Raises:
            NoSourceError: the source shows no pages that it is given.
            PageError, InvalidInputError, LimitError: see `PageStore.append`.
        """
        source = self._plane.source
        if source.pages is None:
            expected = "a source with a modulator, or one that was started with pages"
            raise NoSourceError(f"source {source.name}", "uploaded pages", expected)
        return source.pages.append(symbols, levels)


def _wanted(source: FrameSource) -> pb.WatchDisplayReply:
    """Return what a source waits for: a page on display, beams, or neither.

    Raises:
        NoSourceError: it does all by itself.
    """
    modulator, beams = source.modulator, source.beams
    if not isinstance(modulator, ExternalModulator) and not isinstance(beams, ExternalBeams):
        raise _alone(source)
    state = beams.wanted() if isinstance(beams, ExternalBeams) else None
    return pb.WatchDisplayReply(
        page=modulator.wanted() if isinstance(modulator, ExternalModulator) else None,
        beams=None if state is None else pb.Beams(signal=state.signal, reference=state.reference),
    )


def _alone(source: FrameSource) -> NoSourceError:
    expected = 'a source whose modulator or beams have kind = "external"'
    return NoSourceError(f"source {source.name}", "word from a controller", expected)


async def uploaded_pages(
    messages: AsyncIterator[pb.UploadPagesRequest], page_shape: tuple[int, int], most_bytes: int
) -> tuple[int, NDArray[np.uint8]]:
    """Level count M and pages [page, ny, nx].

    Args:
        messages: messages that the caller sends.
        page_shape: symbols as (rows, columns).
        most_bytes: largest size of all pages together.

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
