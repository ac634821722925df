"""Pages with known symbols that a caller sends, with their frames, checked as they come."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import CallerLeft, InvalidInputError, LimitError, MalformedError, PageError, StalledError
from lightpage.page.levels import check_levels
from lightpage.page.symbols import check_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import frame_type
from lightpage.recording.pixels.black_level import without_black
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.recalibration.known_pages import MIN_PAGES, KnownPages
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.frames.frame_calls import check_black
from lightpage.runtime.service.frames.frames import PairReceiver, check_format, pixel_type

_WHERE = "message of RecalibrateFrames"


class SentPages:
    """Takes reference frames, then symbols and frames of each page, within the service's budget of memory.

    Args:
        header: header of the call.
        plane: says what frames and how many bytes are taken.

    Raises:
        FrameError: not this device's size, type or bit depth.
        LimitError: more pages or bytes than the service takes.
        PageError: an impossible level count, or pilots that do not fit the page.
        InvalidInputError: another value that makes no sense.
    """

    def __init__(self, header: pb.RecalibrateFramesHeader, plane: DataPlane) -> None:
        self._header, self._limits, self._budget = header, plane.limits, plane.received
        self._page_shape = plane.models.current.decoder.bundle.profile.page_shape
        self._shape, self._dtype = (header.rows_px, header.columns_px), pixel_type(header.pixel_type)
        check_format(plane, self._shape, self._dtype, header.bit_depth)
        check_black(header)
        check_levels(header.levels)
        if header.pages < MIN_PAGES:
            raise InvalidInputError("pages", header.pages, f"at least {MIN_PAGES}: one to fit, one to judge by")
        if header.pages > (most := plane.limits.recalibration_pages):
            raise LimitError("pages to recalibrate with", header.pages, f"at most {most}")
        self._mask = _mask(header.pilot_mask, self._page_shape)
        self._symbols: list[NDArray[np.uint8]] = []
        self._receivers = [self._receiver()]
        if (size := self._receivers[0].size * (1 + header.pages)) > (room := plane.limits.receive_bytes):
            raise LimitError("frames to recalibrate with", f"{size} bytes", f"at most {room}")
        self._lock = threading.Lock()
        self._mine = True
        """Whether nobody else has taken them over, or let go of them."""

    async def receive(self, requests: AsyncIterator[pb.RecalibrateFramesRequest]) -> None:
        """Take in everything.

        Raises:
            MalformedError: messages in the wrong order, or fewer or more pages than the header says.
            FrameError: frames of another size than it says.
            PageError: symbols of the wrong size or range.
            LimitError: too large a chunk.
            OverloadedError: more bytes than the service has room for now.
            StalledError: a pair takes too long.
        """
        limit_s, loop = self._limits.receive_s, asyncio.get_running_loop()
        try:
            async with asyncio.timeout(limit_s) as timeout:
                async for part in requests:
                    if self._take(part):
                        timeout.reschedule(loop.time() + limit_s)
        except TimeoutError:
            raise StalledError("frame pair", f"not all of it within {limit_s:g} s", "faster frames") from None
        if self._symbols:
            self._receivers[-1].check()
        if len(self._symbols) < self._header.pages:
            raise MalformedError("pages that came", len(self._symbols), f"{self._header.pages}, as the header says")

    def known(self) -> KnownPages:
        """Return all that was sent, once it has been received."""
        references, *pairs = (self._pair(receiver) for receiver in self._receivers)
        return KnownPages(tuple(pairs), tuple(self._symbols), self._header.levels, references, self._mask)

    def close(self) -> None:
        """Let go of what has come, unless somebody has taken it over."""
        with self._lock:
            mine, self._mine = self._mine, False
        if mine:
            self._release()

    @contextmanager
    def handed_over(self) -> Iterator[Callable[[], None]]:
        """Take over what has come: `close` does nothing any more. Yields what lets go of it; an error does so too.

        Raises:
            CallerLeft: it is closed.
        """
        with self._lock:
            mine, self._mine = self._mine, False
        if not mine:
            raise CallerLeft
        try:
            yield self._release
        except BaseException:
            self._release()
            raise

    def _take(self, part: pb.RecalibrateFramesRequest) -> bool:
        """Take in a message; whether it begins a page."""
        kind, frames = part.WhichOneof("part"), "chunk" if self._symbols else "reference"
        if kind == "symbols":
            self._begin_page(part.symbols)
            return True
        if kind != frames:
            raise MalformedError(_WHERE, kind or "an empty message", f"{frames}, or the next page's symbols")
        chunk, limit = getattr(part, frames), self._limits.chunk_bytes
        if len(chunk) > limit:
            raise LimitError(frames, f"{len(chunk)} bytes", f"at most {limit}")
        self._receivers[-1].add(chunk)  # says that it is too much
        return False

    def _begin_page(self, symbols: bytes) -> None:
        number = len(self._symbols)
        if not self._receivers[-1].filled:
            before = f"frames of page {number - 1}" if number else "reference frames"
            raise MalformedError(_WHERE, f"symbols of page {number}", f"{before} first")
        self._receivers[-1].check()
        if number == self._header.pages:
            raise MalformedError(_WHERE, f"symbols of page {number}", f"{number} pages, as the header says")
        subject, (rows, columns) = f"known page {number}: symbols", self._page_shape
        if len(symbols) != rows * columns:
            raise PageError(subject, f"{len(symbols)} bytes", f"{rows * columns}, a byte for each of {rows}x{columns}")
        page = np.frombuffer(symbols, np.uint8).reshape(rows, columns)
        check_symbols(page, self._page_shape, self._header.levels, subject)
        self._budget.take(page.size)
        self._symbols.append(page)
        self._receivers.append(self._receiver())

    def _receiver(self) -> PairReceiver:
        return PairReceiver(self._shape, self._dtype, self._budget)

    def _pair(self, receiver: PairReceiver) -> FramePair:
        """The frames of a pair without their black level, in the receiver's own memory."""
        pair, header = receiver.pair(), self._header
        for frame in (pair.in_phase, pair.quadrature) if header.black_level else ():
            counts = np.asarray(frame, frame_type(header.bit_depth))
            frame[...] = without_black(counts, header.black_level, header.bit_depth)
        return pair

    def _release(self) -> None:
        receivers, self._receivers = self._receivers, []
        symbols, self._symbols = self._symbols, []
        for receiver in receivers:
            receiver.close()
        self._budget.give_back(sum(page.size for page in symbols))


def _mask(flags: bytes, page_shape: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Return where the pilots are, None for the device's own."""
    if not flags:
        return None
    values = np.frombuffer(flags, np.uint8)
    if values.size != page_shape[0] * page_shape[1]:
        raise PageError("pilot_mask", f"{values.size} flags", f"{page_shape[0]}x{page_shape[1]}, or none")
    if int(values.max()) > 1:
        raise PageError("pilot_mask", f"a flag of {values.max()}", "flags of 0 or 1")
    if (count := np.count_nonzero(values)) in (0, values.size):
        raise PageError("pilot_mask", f"{count} of {values.size} flags that are set", "some that are, and some not")
    return np.asarray(values.reshape(page_shape) != 0)
