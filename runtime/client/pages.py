"""Pages that the service reads from its own source."""

from collections.abc import Iterator, Sequence
from typing import Unpack

from lightpage.errors import LightpageError
from lightpage.runtime.client.answers import RemoteData, RemotePage, remote_data, remote_page
from lightpage.runtime.client.connection import DATA_S, SubClient
from lightpage.runtime.client.outgoing import PageOptions, options_message
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.status import error_from


class PagesClient(SubClient):
    """Has the service read pages from its own source, as symbols or as the bytes that they carry::

        page = client.pages.read(7, request_id="order-7")  # asked again, it takes no second shot

        for found in client.pages.read_many([1, 2, 5]):  # a page, or the error that it ended with
            print(found if isinstance(found, Exception) else found.page)

        found = [page.user_data for page in client.pages.read_data(0, 30)]
        content = {page.header.page: page.data for page in found if page.header and page.data is not None}

    `read` raises the error of a page that is lost; the others go on with the next one.
    """

    def read(
        self,
        page: int | None = None,
        levels: int | None = None,
        *,
        want_written: bool = False,
        request_id: str = "",
        **options: Unpack[PageOptions],
    ) -> RemotePage:
        """Read a page; None stands for the next page and the source's levels.

        Args:
            page: its number.
            levels: M, 2..256.
            want_written: also get what the source knows to have been written.
            request_id: a text that is new for each page. Asked again with the same one, the service takes no second
                shot: it gives the same answer, with `RemotePage.replayed` set.
            options: what to get, and whose pages the page is followed with; see `PageOptions`.

        Raises:
            SourceError: the service has no source, or one that is damaged or dark.
            LostPageError: the page is lost; its `reason` says why.
            PageError: no such page, or an impossible level count.
            RequestIdError: the request id was given with another request.
            SlotsTakenError: the service had no free slot until the deadline.
        """
        reply: pb.ReadPageReply = self._ask(
            "ReadPage",
            page=page,
            options=options_message(levels or 0, options),
            want_written=want_written,
            request_id=request_id,
            correlation_id=options.get("correlation_id"),
        )
        return remote_page(reply.decoded, reply)

    def read_many(
        self,
        pages: Sequence[int] = (),
        levels: int | None = None,
        *,
        count: int = 0,
        want_written: bool = False,
        timeout_s: float = DATA_S,
        **options: Unpack[PageOptions],
    ) -> Iterator[RemotePage | LightpageError]:
        """Read pages in one call; yield each, or why there is none, in their order.

        Args:
            pages: their numbers; none for the next `count`.
            timeout_s: time for all of them.
            levels: levels of every page, as for `read`.
            want_written: choice of every page, as for `read`.
            options: options of every page, as for `read`.

        Raises:
            SourceError: the service has no source.
            LimitError: more pages than the service reads in one call.
            LightpageError: the whole call ended.
        """
        with self._replies(
            "ReadPages",
            timeout_s=timeout_s,
            pages=pages,
            count=count,
            options=options_message(levels or 0, options),
            want_written=want_written,
            correlation_id=options.get("correlation_id"),
        ) as replies:
            for reply in replies:
                refused, read = reply.HasField("refused"), reply.read
                yield error_from(reply.refused.detail) if refused else remote_page(read.decoded, read)

    def read_data(self, first: int, pages: int, timeout_s: float = DATA_S) -> Iterator[RemoteData]:
        """Read the bytes of pages `first` to `first + pages - 1`, and yield them.

        Lost pages come as such; those that parity restores follow at the end of their group. A service that
        recalibrates itself may do so for lost pages, for a minute or more, and those that it then reads come once more.

        Raises:
            BundleError: the model in service has no code.
            SourceError: the service has no source, or one that is damaged or dark.
            PageError: no such page.
        """
        with self._replies("ReadData", timeout_s=timeout_s, first_page=first, pages=pages) as replies:
            yield from map(remote_data, replies)
