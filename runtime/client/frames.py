"""Frames that a caller has, sent or shared, and decoded by the service."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import LightpageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.answers import RemotePage, remote_page
from lightpage.runtime.client.connection import DATA_S, SubClient
from lightpage.runtime.client.outgoing import FrameOptions, header_message, sent_frames
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.shared_memory import SharedMemory
from lightpage.runtime.client.wire.messages import FramePart, chunks_of
from lightpage.runtime.client.wire.status import error_from


class FramesClient(SubClient):
    """Decodes frame pairs that the caller has, with the model in service::

        page = client.frames.decode(FramePair(in_phase, quadrature), levels=16, want_phase=True)
        print(page.symbols, page.confidence.mean())

        for found in client.frames.decode_many(pairs):  # a page, or the error that it ended with
            print(found if isinstance(found, Exception) else found.frame_id)

    A client on the same machine need not send its frames: `share_memory` gives it memory to write them into.
    """

    def decode(
        self,
        pair: FramePair,
        levels: int = 0,
        *,
        frame_id: int = 0,
        captured_s: float = 0.0,
        memory: SharedMemory | None = None,
        **options: Unpack[FrameOptions],
    ) -> RemotePage:
        """Send a frame pair and return its symbols.

        Args:
            pair: both frames, uint8 or uint16.
            levels: M of the page, 2..256; of another one the symbols mean nothing. 0 for the default of the service,
                `Description.default_levels`, or that of the model's code where user bytes are asked for.
            frame_id: the caller's number of the pair; the page has it too.
            captured_s: the caller's time of the exposure; the page has it too.
            memory: where the pair goes in place of being sent; it may be there already, as `SharedMemory.frames`.
            options: what the frames are, what to get, and whose pages the page is followed with; see `FrameOptions`
                and `PageOptions`.

        Raises:
            FrameError: frames that cannot be sent, or that the service refuses.
            PageError: an impossible level count, or pilots that do not fit the page.
            SlotsTakenError: the service had no free slot until the deadline.
        """
        frames = sent_frames(pair)
        own = {"frame_id": frame_id, "captured_s": captured_s}
        header = header_message(self._connection, frames[0], levels, options, **own)
        if memory is None:
            return remote_page(self._ask("DecodeFrames", _parts(header, frames)))
        header.shared.offset, header.shared.region = memory.write(pair), memory.handle
        return remote_page(self._ask("DecodeFrames", header=header))  # one message needs no sending thread

    def decode_many(
        self, pairs: Iterable[FramePair], levels: int = 0, *, timeout_s: float = DATA_S, **options: Unpack[FrameOptions]
    ) -> Iterator[RemotePage | LightpageError]:
        """Send frame pairs one after another in one call; yield each one's page, or why there is none, in their order.

        The service reads the next pair while it decodes one. `RemotePage.frame_id` counts the pairs from 0.

        Args:
            pairs: taken as fast as the service reads them.
            timeout_s: time for all of them.
            levels: levels of every pair, as for `decode`.
            options: options of every pair, as for `decode`.

        Raises:
            FrameError: frames that cannot be sent.
            LightpageError: the whole call ended.
        """
        failed: list[Exception] = []
        if options.get("bit_depth") is None:
            options["bit_depth"] = self._connection.description.bit_depth  # now: the sending thread asks nothing

        def parts() -> Iterator[FramePart]:
            try:
                for number, pair in enumerate(pairs):
                    frames = sent_frames(pair)
                    header = header_message(self._connection, frames[0], levels, options, frame_id=number)
                    yield from _parts(header, frames)
            except Exception as error:  # gRPC would tell of it on stderr, and end the call with UNKNOWN
                failed.append(error)

        try:
            with self._replies("DecodePages", parts(), timeout_s) as replies:
                for reply in replies:
                    refused = reply.HasField("refused")
                    yield error_from(reply.refused.detail) if refused else remote_page(reply.decoded)
        except LightpageError:
            if not failed:
                raise
        if failed:
            raise failed[0]

    def share_memory(self, size: int = 0) -> SharedMemory:
        """Return memory that is shared with a service on this machine, for `decode`, to be closed.

        Args:
            size: bytes; 0 for a pair of the service's camera.

        Raises:
            InvalidInputError: the service is not at a Unix socket.
            LightpageError: it shares no memory, or not as much.
        """
        if not size:
            told = self._connection.description
            size = 2 * int(np.prod(told.frame_shape)) * np.dtype(told.frame_dtype).itemsize
        return SharedMemory(self._connection.target, size)


def _parts(header: pb.DecodeHeader, frames: Sequence[NDArray[np.integer]]) -> Iterator[FramePart]:
    """The messages that send a pair."""
    yield pb.DecodeFramesRequest(header=header)
    yield from chunks_of(frames)
