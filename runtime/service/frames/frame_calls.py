"""Frame pairs that callers send: DecodeFrames, DecodePages."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable
from contextlib import asynccontextmanager
from functools import partial

import numpy as np

from lightpage.errors import InvalidInputError, LightpageError, LimitError, MalformedError, StalledError
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import frame_type
from lightpage.recording.pixels.black_level import without_black
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import FramePart
from lightpage.runtime.client.wire.status import reason_told, refusal_of
from lightpage.runtime.model.decoding.turns import Turn, Turns
from lightpage.runtime.service.caller import Call, Caller, Role
from lightpage.runtime.service.dataplane import DataPlane, levels_for
from lightpage.runtime.service.frames.frames import (
    PairReceiver,
    check_format,
    check_options,
    decode,
    decode_reply,
    pilots_of,
    pixel_type,
)
from lightpage.runtime.service.rpc import rpc
from lightpage.runtime.service.stages import Stage, Stages

_ON_THEIR_WAY = 2
"""Pairs of one DecodePages that are received or decoded at a time: one is decoded while the next one comes. Where pages
are computed together, there are more."""


class _Counted:
    """Messages of a stream, and the bytes of frames that they brought."""

    def __init__(self, requests: AsyncIterator[FramePart]) -> None:
        self._requests, self.bytes = requests, 0

    def __aiter__(self) -> _Counted:
        return self

    async def __anext__(self) -> FramePart:
        part = await anext(self._requests)
        self.bytes += part.nbytes if isinstance(part, memoryview) else 0
        return part


class FrameCalls:
    """Handlers of the calls that send frames.

    Args:
        plane: decodes.
    """

    def __init__(self, plane: DataPlane) -> None:
        self._plane = plane

    @rpc(Role.DECODE)
    async def DecodeFrames(self, requests: AsyncIterator[FramePart], call: Call) -> pb.DecodeReply:
        """Receive a frame pair and decode it."""
        stages = call.times.page()
        stages.begin(Stage.RECEIVE)
        header = _header(await anext(requests, None), call)
        receiver = await self._receive(header, requests, call)
        try:
            async with self._in_time():
                async for part in requests:
                    receiver.add(self._chunk(part))  # says that it is too much
        except BaseException:
            receiver.close()
            raise
        return await call.in_thread(partial(self._decode, receiver, header, call, stages), receiver.close)

    @rpc(Role.DECODE)
    async def DecodePages(self, requests: AsyncIterator[FramePart], call: Call) -> AsyncIterator[pb.DecodePagesReply]:
        """Receive frame pairs, one after another, and decode each while the next one comes."""
        pending: asyncio.Queue[tuple[asyncio.Future[pb.DecodePagesReply], Stages] | None] = asyncio.Queue()
        room, turns = asyncio.Semaphore(self._plane.ahead(_ON_THEIR_WAY)), Turns()

        async def receive() -> None:
            try:
                async for message in requests:
                    stages = call.times.page(time.perf_counter())
                    stages.begin(Stage.QUEUE)
                    await room.acquire()
                    stages.begin(Stage.RECEIVE)
                    outcome = await self._begin(_header(message, call), requests, call, stages, turns)
                    pending.put_nowait((asyncio.ensure_future(outcome), stages))
            finally:
                pending.put_nowait(None)

        receiving = asyncio.ensure_future(receive())
        try:
            while (work := await pending.get()) is not None:
                outcome, stages = work
                yield await outcome
                call.times.done(stages)
                room.release()
            await receiving
        finally:
            receiving.cancel()

    async def _begin(
        self, header: pb.DecodeHeader, requests: AsyncIterator[FramePart], call: Call, stages: Stages, turns: Turns
    ) -> Awaitable[pb.DecodePagesReply]:
        """Receive a pair of many, and begin to decode it. One that is refused is read to its end: others follow."""
        counted = _Counted(requests)
        try:
            receiver = await self._receive(header, counted, call)
        except (MalformedError, StalledError):
            raise  # where the next pair would begin is not known
        except LightpageError as error:
            await self._skip(header, counted, error)
            return self._refused(error, header, stages)
        order = turns.take(self._plane.waiting(_caller(header, call))) if self._plane.together > 1 else None

        def never() -> None:
            receiver.close()
            if order is not None:
                order.close()

        return call.in_thread(partial(self._outcome, receiver, header, call, stages, order), never)

    async def _skip(self, header: pb.DecodeHeader, requests: _Counted, error: LightpageError) -> None:
        """Drop what is left of a pair."""
        size = 2 * header.rows_px * header.columns_px * np.dtype(pixel_type(header.pixel_type)).itemsize
        if size > self._plane.limits.pair_bytes:
            raise error
        if header.HasField("shared"):  # nothing follows
            return
        async with self._in_time():
            while requests.bytes < size and (part := await anext(requests, None)) is not None:
                self._chunk(part)

    async def _receive(self, header: pb.DecodeHeader, requests: AsyncIterator[FramePart], call: Call) -> PairReceiver:
        """Take in the chunks of a pair, as soon as its header is known to be right and there will be time for it.

        Returns:
            what holds the pair, to be closed once that is decoded.
        """
        self.check(header)
        self._plane.check_time(_caller(header, call))
        shape = header.rows_px, header.columns_px
        receiver = PairReceiver(shape, pixel_type(header.pixel_type), self._plane.received)
        try:
            if header.HasField("shared"):
                await call.in_thread(partial(self._take_shared, header.shared, receiver))
            async with self._in_time():
                while not receiver.complete and (part := await anext(requests, None)) is not None:
                    receiver.add(self._chunk(part))
            receiver.check()
            return receiver
        except BaseException:
            receiver.close()
            raise

    def _take_shared(self, where: pb.SharedFrames, receiver: PairReceiver) -> None:
        """Copy a pair out of shared memory: its client may change it."""
        if (shared := self._plane.shared) is None:
            raise InvalidInputError("header.shared", "a region", "pixels: this service shares no memory")
        with shared.reading(where.region, where.offset, receiver.size) as pixels:
            receiver.add(pixels)

    @asynccontextmanager
    async def _in_time(self) -> AsyncIterator[None]:
        """Give up on a sender who takes too long in the `with` statement, however little it sends meanwhile."""
        limit_s = self._plane.limits.receive_s
        try:
            async with asyncio.timeout(limit_s):
                yield
        except TimeoutError:
            raise StalledError("frame pair", f"not all of it within {limit_s:g} s", "faster frames") from None

    def _chunk(self, part: FramePart) -> memoryview:
        if not isinstance(part, memoryview):
            got = "a second header" if part.HasField("header") else "an empty message"
            raise MalformedError("message of a frame pair", got, "chunks from there on")
        limit = self._plane.limits.chunk_bytes
        if part.nbytes > limit:
            raise LimitError("chunk", f"{part.nbytes} bytes", f"at most {limit}")
        return part

    def _outcome(
        self, receiver: PairReceiver, header: pb.DecodeHeader, call: Call, stages: Stages, order: Turn | None
    ) -> pb.DecodePagesReply:
        try:
            return pb.DecodePagesReply(decoded=self._decode(receiver, header, call, stages, order))
        except Exception as error:
            return self._refusal(error, header, stages)
        finally:
            if order is not None:
                order.close()

    def check(self, header: pb.DecodeHeader) -> None:
        """Check what a header says of its frames, and what it asks for.

        Raises:
            LimitError, FrameError: see `check_format`.
            InvalidInputError: what is not to be had of any page.
        """
        shape, dtype = (header.rows_px, header.columns_px), pixel_type(header.pixel_type)
        check_format(self._plane, shape, dtype, header.bit_depth)
        check_options(header.options)
        check_black(header)
        self._pilots(header)

    def decode(
        self,
        pair: FramePair,
        header: pb.DecodeHeader,
        call: Call,
        stages: Stages,
        version: str = "",
        order: Turn | None = None,
    ) -> pb.DecodeReply:
        """Decode a pair that has come, whose header was checked; raises as `DataPlane.decode`.

        Args:
            pair: frames of the pair.
            header: header of the pair.
            call: call that brought it.
            stages: clock of its stages.
            version: version of the model that must be in service; empty for any.
            order: order of the pairs of its call; by default it is alone.
        """
        options = header.options
        answer = decode(
            self._plane,
            _without_black(pair, header),
            options.levels or None,
            _caller(header, call),
            self._pilots(header),
            user_data=options.want_user_data,
            stages=stages,
            version=version,
            order=order,
        )
        return decode_reply(answer, options, header.correlation_id, header.frame_id, header.captured_s)

    def _pilots(self, header: pb.DecodeHeader) -> Pilots | None:
        """The caller's own pilots."""
        options, decoder = header.options, self._plane.models.current.decoder
        levels = levels_for(decoder, options.levels or None, self._plane.default_levels, options.want_user_data)
        if not header.HasField("pilots"):
            return None
        return pilots_of(header.pilots, decoder.bundle, levels)

    def _decode(
        self, receiver: PairReceiver, header: pb.DecodeHeader, call: Call, stages: Stages, order: Turn | None = None
    ) -> pb.DecodeReply:
        """Decode a pair that was received, and let go of it."""
        try:
            return self.decode(receiver.pair(), header, call, stages, order=order)
        finally:
            receiver.close()

    async def _refused(self, error: Exception, header: pb.DecodeHeader, stages: Stages) -> pb.DecodePagesReply:
        return self._refusal(error, header, stages)

    def _refusal(self, error: Exception, header: pb.DecodeHeader, stages: Stages) -> pb.DecodePagesReply:
        stages.begin(Stage.RESPOND)
        self._plane.metrics.rejected(reason_told(error))
        refused = refusal_of(error)
        refused.frame_id, refused.correlation_id = header.frame_id, header.correlation_id
        return pb.DecodePagesReply(refused=refused)


def _header(first: FramePart | None, call: Call) -> pb.DecodeHeader:
    if first is None or isinstance(first, memoryview) or first.WhichOneof("part") != "header":
        raise MalformedError(f"first message of {call.method}", "no header", "a header, then chunks")
    call.correlation_id = first.header.correlation_id or call.correlation_id
    return first.header


def _caller(header: pb.DecodeHeader, call: Call) -> Caller:
    """The caller, whose pages without a session of their own are those of its connection, or of none."""
    session = call.session(header.options.session) or call.connection_session
    stateless = not session or header.options.tracking == pb.TRACKING_STATELESS
    return call.caller.in_session(session, stateless, header.options.least_steps)


def check_black(header: pb.DecodeHeader | pb.RecalibrateFramesHeader) -> None:
    """Check the black level of a header whose bit depth was checked before: full scale has as many bits.

    Raises:
        InvalidInputError: no count would be left above it.
    """
    if header.black_level and header.black_level >= (full_scale := (1 << header.bit_depth) - 1):
        raise InvalidInputError("black_level", header.black_level, f"less than {full_scale}, which is full scale")


def _without_black(pair: FramePair, header: pb.DecodeHeader) -> FramePair:
    level, bits = header.black_level, header.bit_depth
    frames = (np.asarray(frame, frame_type(bits)) for frame in (pair.in_phase, pair.quadrature))
    return FramePair(*(without_black(frame, level, bits) for frame in frames)) if level else pair
