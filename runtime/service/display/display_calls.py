"""The controller's side of the modulator: UploadPages, WatchDisplay, ReportDisplay."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from lightpage.errors import InvalidInputError, StalledError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.modulator.beam_state import BeamState
from lightpage.runtime.service.caller import Call
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.display.display import Display, Wanted
from lightpage.runtime.service.display.uploads import uploaded_pages

_POLL_S = 0.02
"""How often is looked for something new to show."""


class DisplayCalls:
    """Handlers of the calls about what is shown.

    Args:
        plane: has the display.
    """

    def __init__(self, plane: DataPlane) -> None:
        self._plane = plane

    async def UploadPages(self, requests: AsyncIterator[pb.UploadPagesRequest], call: Call) -> pb.UploadPagesReply:
        """Receive pages to show."""
        limits, shape = self._plane.limits, self._plane.registry.current.decoder.bundle.profile.page_shape
        try:
            async with asyncio.timeout(limits.receive_s):
                levels, symbols = await uploaded_pages(requests, shape, limits.uploaded_bytes)
        except TimeoutError:
            late = f"not all of them within {limits.receive_s:g} s"
            raise StalledError("uploaded pages", late, "faster pages") from None
        first = await call.in_thread(lambda: Display(self._plane.source).upload(symbols, levels))
        return pb.UploadPagesReply(first_page=first, pages=len(symbols))

    async def WatchDisplay(self, request: pb.WatchDisplayRequest, call: Call) -> AsyncIterator[pb.WatchDisplayReply]:
        """Tell a controller what to show."""
        with self._plane.watches.held_at_once():
            last, display = None, Display(self._plane.source)
            while True:
                if (wanted := display.wanted()) != last:
                    last = wanted
                    yield wanted_message(wanted)
                await asyncio.sleep(_POLL_S)

    def ReportDisplay(self, request: pb.ReportDisplayRequest, call: Call) -> pb.ReportDisplayReply:
        """Hear from a controller what is shown."""
        kind, display = request.WhichOneof("what"), Display(self._plane.source)
        if kind is None:
            raise InvalidInputError("report of the display", "nothing", "a page, its end, or beams")
        if kind == "beams":
            display.beams_set(BeamState(request.beams.signal, request.beams.reference))
        else:
            display.shown(request.page if kind == "page" else None)
        return pb.ReportDisplayReply()


def wanted_message(wanted: Wanted) -> pb.WatchDisplayReply:
    """What a controller is to show as its message."""
    beams = wanted.beams
    return pb.WatchDisplayReply(
        page=wanted.page,
        beams=None if beams is None else pb.Beams(signal=beams.signal, reference=beams.reference),
    )
