"""Calls of a controller that shows pages, or moves shutters, for the service's source."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lightpage.runtime.client.answers import DisplayOrder, display_order
from lightpage.runtime.client.connection import SubClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import CHUNK_BYTES, message_of


class DisplayClient(SubClient):
    """Shows pages and moves shutters for the service, where the caller works them and not the service itself::

        first = client.display.upload_pages(symbols, levels=16)  # a modulator of the service's own shows these too

        for order in client.display.watch():
            if order.page is not None:
                modulator.show(order.page)
                client.display.report_page(order.page)

    What is reported has settled: the service takes its frames at once.
    """

    def upload_pages(self, symbols: NDArray[np.uint8], levels: int) -> int:
        """Give the source's modulator pages [page, ny, nx] of M levels to show; return the first one's number.

        Raises:
            SourceError: the source shows no pages that it is given.
            PageError: another shape, or symbols beyond the levels.
            InvalidInputError: other levels than the pages that are there.
            LimitError: more than the service holds.
        """
        pages = np.ascontiguousarray(symbols, np.uint8)
        pages = pages.reshape(-1, *pages.shape[-2:])
        first = message_of(pb.UploadPagesRequest, levels=levels)

        def parts() -> Iterator[pb.UploadPagesRequest]:
            yield first
            step = max(1, CHUNK_BYTES // max(1, pages[0].size)) if len(pages) else 1
            for start in range(0, len(pages), step):
                yield pb.UploadPagesRequest(symbols=pages[start : start + step].tobytes())

        reply: pb.UploadPagesReply = self._ask("UploadPages", parts())
        return reply.first_page

    def watch(self, timeout_s: float | None = None) -> Iterator[DisplayOrder]:
        """Yield what the service waits for, at first and at every change, until the iterator is closed.

        Raises:
            SourceError: the source's device shows its pages, and moves its shutters, by itself.
        """
        with self._replies("WatchDisplay", timeout_s=timeout_s) as replies:
            yield from map(display_order, replies)

    def report_page(self, page: int | None) -> None:
        """Say which page is on display and has settled; None for none from now on.

        Raises:
            SourceError: the source's device shows its pages by itself.
        """
        shown = {"withdrawn": True} if page is None else {"page": page}
        self._ask("ReportDisplay", **shown)

    def report_beams(self, *, signal: bool, reference: bool) -> None:
        """Say which beams are let through and have settled.

        Raises:
            SourceError: the source's device moves its shutters by itself.
        """
        self._ask("ReportDisplay", beams={"signal": signal, "reference": reference})
