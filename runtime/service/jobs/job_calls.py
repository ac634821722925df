"""Recalibration as a job: Recalibrate, StartRecalibration, RecalibrateFrames, ListJobs, GetJob, WatchJob, CancelJob."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator
from functools import partial

from lightpage.errors import InvalidInputError, MalformedError, OverloadedError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.service.caller import Call, Role
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.messages import result_message
from lightpage.runtime.service.jobs.recalibrator import PagesToUse, Recalibrator, Step
from lightpage.runtime.service.jobs.sent_pages import SentPages
from lightpage.runtime.service.rpc import rpc

_POLL_S = 0.1
"""How often is looked whether a job has changed."""

_CANCEL_S = 2.0
"""A cancelled job is waited for so long, to be told as it ends."""

_WATCHES = 256
"""Watched at once: each looks for changes many times a second."""


class JobCalls:
    """Handlers of the calls that recalibrate.

    Args:
        plane: says what frames and how many bytes are taken.
        recalibrator: recalibrator of the service.
        clock: seconds that never go back.
    """

    def __init__(
        self, plane: DataPlane, recalibrator: Recalibrator, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._plane, self._recalibrator, self._jobs = plane, recalibrator, recalibrator.jobs
        self._clock, self._watches = clock, 0

    @rpc(Role.RECALIBRATE)
    def Recalibrate(self, request: pb.RecalibrateRequest, call: Call) -> Iterator[pb.RecalibrateReply]:
        """Recalibrate and tell how it goes."""
        pages = self._pages(request)
        for step in self._recalibrator.follow(pages, call.caller, request.expected_version, call.correlation_id):
            if isinstance(step, Step):
                yield pb.RecalibrateReply(progress=pb.Progress(step=step.name, fraction=step.fraction))
            else:
                yield pb.RecalibrateReply(result=result_message(step))

    @rpc(Role.RECALIBRATE)
    def StartRecalibration(self, request: pb.StartRecalibrationRequest, call: Call) -> pb.Job:
        """Start a recalibration that goes on when its caller leaves."""
        return self._recalibrator.start(
            self._pages(request), request.expected_version, request.correlation_id, call.actor
        )

    @rpc(Role.RECALIBRATE, is_upload=True)
    async def RecalibrateFrames(self, requests: AsyncIterator[pb.RecalibrateFramesRequest], call: Call) -> pb.Job:
        """Receive known pages, and start a recalibration with them."""
        first = await anext(requests, None)
        if first is None or first.WhichOneof("part") != "header":
            raise MalformedError(f"first message of {call.method}", "no header", "a header, then reference frames")
        header = first.header
        call.correlation_id = header.correlation_id or call.correlation_id
        self._recalibrator.check_start(header.expected_version)  # before all those frames come
        sent = SentPages(header, self._plane)
        try:
            await sent.receive(requests)
            return await call.in_thread(partial(self._start_with, sent, header, call))
        finally:
            sent.close()  # does nothing where the job has taken them

    @rpc(Role.READ)
    def ListJobs(self, request: pb.ListJobsRequest, call: Call) -> pb.ListJobsReply:
        """All jobs that are kept."""
        return pb.ListJobsReply(jobs=self._jobs.all())

    @rpc(Role.READ)
    def GetJob(self, request: pb.GetJobRequest, call: Call) -> pb.Job:
        """A job as it is now."""
        return self._jobs.job(request.id)

    @rpc(Role.READ, is_watch=True)
    async def WatchJob(self, request: pb.WatchJobRequest, call: Call) -> AsyncIterator[pb.Job]:
        """A job at each change."""
        if self._watches >= _WATCHES:
            raise OverloadedError("watches of jobs", "all taken", f"at most {_WATCHES} at once", retry_s=1.0)
        self._watches += 1
        try:
            last = None
            while True:
                job = self._jobs.job(request.id)
                if job != last:
                    last = job
                    yield job
                if job.state != pb.JOB_STATE_RUNNING:
                    return
                await asyncio.sleep(_POLL_S)
        finally:
            self._watches -= 1

    @rpc(Role.RECALIBRATE)
    async def CancelJob(self, request: pb.CancelJobRequest, call: Call) -> pb.Job:
        """Have a job end at its next step."""
        self._jobs.cancel(request.id)
        until = self._clock() + _CANCEL_S
        while (job := self._jobs.job(request.id)).state == pb.JOB_STATE_RUNNING and self._clock() < until:
            await asyncio.sleep(_POLL_S)
        return job

    def _pages(self, request: pb.RecalibrateRequest | pb.StartRecalibrationRequest) -> PagesToUse:
        kind = request.WhichOneof("pages")
        if kind == "source":
            return self._recalibrator.source_pages(request.source.count, list(request.source.pages))
        if kind == "recording":
            return self._recalibrator.recorded_pages(request.recording, request.recording_count)
        raise InvalidInputError("pages", "none", "pages of the source or a recording")

    def _start_with(self, sent: SentPages, header: pb.RecalibrateFramesHeader, call: Call) -> pb.Job:
        with sent.handed_over() as release:
            pages = self._recalibrator.sent_pages(sent.known(), release)
            return self._recalibrator.start(pages, header.expected_version, header.correlation_id, call.actor)
