"""Pages of the service's own source: ReadPage, ReadPages, ReadData."""

from collections.abc import Iterator
from contextlib import suppress
from functools import partial

from lightpage.clock import Clock
from lightpage.errors import CallerLeft, InvalidInputError, LimitError, SlotsTakenError
from lightpage.runtime.archives.recordings.read_ahead import beside
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import message_of
from lightpage.runtime.client.wire.status import detail_of, reason_told, refusal_of
from lightpage.runtime.model.decoding.turns import Turn, Turns
from lightpage.runtime.service.caller import Call, Caller, Role
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.frames.frames import check_options, decode_reply, user_data_message
from lightpage.runtime.service.pages.reading import DataPage, ReadAnswer, Unread, read_again, read_data, read_page
from lightpage.runtime.service.pages.replays import Replays
from lightpage.runtime.service.rpc import rpc
from lightpage.runtime.service.stages import Stage, Stages

_MOST_PAGES = 1 << 32
"""Of a source: their numbers travel in 32 bits."""


class PageCalls:
    """Handlers of the calls that read pages.

    Args:
        plane: reads and decodes.
        clock: clock by which callers wait; that of the service if None.

    Attributes:
        replays: answers that are given again to whoever asks with the same request id.
    """

    def __init__(self, plane: DataPlane, clock: Clock | None = None) -> None:
        self._plane, self._clock, limits = plane, clock or plane.clock, plane.limits
        self.replays = Replays(limits.replay_s, limits.replay_bytes, self._clock)

    @rpc(Role.DECODE)
    def ReadPage(self, request: pb.ReadPageRequest, call: Call) -> pb.ReadPageReply:
        """Read a page from the source and decode it; with a request id at most once."""
        stages = call.times.page()
        stages.begin(Stage.QUEUE)
        check_options(request.options)
        caller = _caller(request.options, call)
        if not request.request_id:
            return self._read(request, caller, stages)
        limit_s = self._plane.limits.deadline_s

        def work() -> bytes:
            # The answer is wanted even where its caller leaves meanwhile, and asks again.
            until = self._clock.now() + limit_s
            detached = Caller(
                lambda: until - self._clock.now(), caller.session, caller.stateless, caller.actor, caller.least_steps
            )
            return self._read(request, detached, stages).SerializeToString()

        same = pb.ReadPageRequest()
        same.CopyFrom(request)
        same.correlation_id = ""
        asked = same.SerializeToString(deterministic=True)
        answer, replayed = self.replays.once(call.own(request.request_id), asked, caller, work)
        stages.begin(Stage.RESPOND)
        reply = pb.ReadPageReply.FromString(answer)
        reply.replayed, reply.decoded.correlation_id = replayed, request.correlation_id
        return reply

    @rpc(Role.DECODE, is_range=True)
    def ReadPages(self, request: pb.ReadPagesRequest, call: Call) -> Iterator[pb.ReadPagesReply]:
        """Read several pages; a lost one ends nothing."""
        check_options(request.options)
        self._check_count("pages" if request.pages else "count", len(request.pages) or request.count)
        caller = _caller(request.options, call)
        numbers: list[int | None] = list(request.pages) or [None] * request.count
        turns, read = Turns(), partial(self._of_range, request, caller, call)
        waiting = self._plane.waiting(caller)
        # of pages that come next, none is taken off the source that is not answered
        threads = self._plane.ahead() if request.pages else 1
        ordered = ((number, turns.take(waiting)) for number in numbers)
        pages = beside(read, ordered, threads, lambda at: at[1].close())
        for _ in numbers:
            with self._plane.ranges.held(caller):  # not while the caller takes its time to read the reply
                _, result = next(pages)
                reply, stages = result()
            yield reply
            call.times.done(stages)

    def _of_range(
        self, request: pb.ReadPagesRequest, caller: Caller, call: Call, at: tuple[int | None, Turn]
    ) -> tuple[pb.ReadPagesReply, Stages]:
        """Read one of several pages."""
        number, order = at
        one = pb.ReadPageRequest(options=request.options, want_written=request.want_written)
        one.correlation_id = request.correlation_id
        if number is not None:
            one.page = number
        stages = call.times.page()
        try:
            return pb.ReadPagesReply(read=self._read(one, caller, stages, order)), stages
        except (CallerLeft, SlotsTakenError):
            raise
        except Exception as error:
            stages.begin(Stage.RESPOND)
            self._plane.metrics.rejected(reason_told(error))
            refused = refusal_of(error)
            refused.page, refused.correlation_id = number or 0, request.correlation_id
            return pb.ReadPagesReply(refused=refused), stages

    @rpc(Role.DECODE, is_range=True)
    def ReadData(self, request: pb.ReadDataRequest, call: Call) -> Iterator[pb.ReadDataReply]:
        """Read the bytes of a range of pages."""
        self._check_count("pages", request.pages)
        if request.first_page + request.pages > _MOST_PAGES:
            raise InvalidInputError("first_page", request.first_page, f"less than {_MOST_PAGES} with all")
        plane, caller, timed, unread = self._plane, call.caller, call.times.page, Unread()
        yield from self._sent(read_data(plane, request.first_page, request.pages, caller, timed, unread), call)
        if unread.pages and plane.heal is not None and plane.heal(caller, unread.model_version, len(unread.pages)):
            with suppress(SlotsTakenError):  # all of them are told of as lost
                yield from self._sent(read_again(plane, unread, caller, timed), call, again=True)

    def _sent(self, pages: Iterator[DataPage], call: Call, *, again: bool = False) -> Iterator[pb.ReadDataReply]:
        """Pages of a range as messages; those that are read `again` only where they give their bytes."""
        while True:
            with self._plane.ranges.held(call.caller):  # not while the caller takes its time to read the reply
                page = next(pages, None)
            if page is None:
                return
            if again and (page.found is None or page.found.loss is not None):
                continue
            if page.error is not None:
                self._plane.metrics.rejected(reason_told(page.error))
            yield data_reply(page)
            if page.stages is not None:
                call.times.done(page.stages)

    def _read(
        self, request: pb.ReadPageRequest, caller: Caller, stages: Stages, order: Turn | None = None
    ) -> pb.ReadPageReply:
        page, options = request.page if request.HasField("page") else None, request.options
        levels, user_data = options.levels or None, options.want_user_data
        read = read_page(self._plane, page, levels, caller, user_data=user_data, stages=stages, order=order)
        return read_reply(read, request)

    def _check_count(self, subject: str, count: int) -> None:
        most = self._plane.limits.range_pages
        if count < 1:
            raise InvalidInputError(subject, count, "at least 1")
        if count > most:
            raise LimitError(subject, count, f"at most {most}")


def _caller(options: pb.DecodeOptions, call: Call) -> Caller:
    """The caller with its session; without one, the pages are those of the device."""
    stateless = options.tracking == pb.TRACKING_STATELESS
    return call.caller.in_session(call.session(options.session), stateless, options.least_steps)


def data_reply(page: DataPage) -> pb.ReadDataReply:
    """Return a page of a range as its message."""
    return message_of(
        pb.ReadDataReply,
        page,
        page=page.source_page,
        user_data=pb.UserData(loss=pb.DATA_LOSS_OPTICS) if page.found is None else user_data_message(page.found),
        restored=page.source_page is None,
        error=None if page.error is None else detail_of(page.error),
    )


def read_reply(read: ReadAnswer, request: pb.ReadPageRequest) -> pb.ReadPageReply:
    """Return a page read from the source as its message."""
    written = read.shot.symbols if request.want_written else None
    return message_of(
        pb.ReadPageReply,
        decoded=decode_reply(read.answer, request.options, request.correlation_id),
        page=read.shot.page_index,
        written=written,
        pilot_mask=None if written is None else read.pilot_mask,
        frames=read.shot.infos,
    )
