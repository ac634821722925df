"""The recalibrations of a service, each of them a job."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypedDict, Unpack

import grpc
import numpy as np
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError, LightpageError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.answers import JobInfo, Recalibrated, job_info
from lightpage.runtime.client.connection import DATA_S, SubClient
from lightpage.runtime.client.outgoing import format_of, sent_frames, sent_symbols
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import answer_of, chunks_of, message_of
from lightpage.runtime.client.wire.status import error_of, is_lost_connection

RECALIBRATION_S = 600.0
"""Deadline of a recalibration where none is given."""

_WATCH_S = 60.0
"""A watch that hears nothing for so long begins anew: a network that swallows everything tells nobody."""

_AGAIN_S = 0.5
"""From a lost connection to the next try."""


class RecalibrationOptions(TypedDict, total=False):
    """Pages of a recalibration, and the model that it replaces. All but the pages may be left out.

    Attributes:
        count: how many of the source's next pages; or of the recording's first ones, 0 for all of them.
        pages: which pages of the source.
        recording: its name in the service's recordings folder.
        expected_version: version that must be in service; empty for any.
    """

    count: int
    pages: Sequence[int]
    recording: str | None
    expected_version: str


class JobsClient(SubClient):
    """Recalibrates, at once or by a job of the service, which goes on when its caller leaves::

        result = client.jobs.recalibrate(count=2)

        job = client.jobs.start(count=2, expected_version="bench-9")
        for job in client.jobs.watch(job.id):
            print(job.state, f"{job.fraction:.0%}", job.step)

    One runs at a time. What begins one takes the version that must be in service, empty for any.
    """

    def recalibrate(
        self,
        *,
        progress: Callable[[str, float], None] = lambda step, fraction: None,
        timeout_s: float = RECALIBRATION_S,
        **options: Unpack[RecalibrationOptions],
    ) -> Recalibrated:
        """Recalibrate and wait for the result; the recalibration is dropped when the call ends early.

        Args:
            progress: told what is being done, and how far all of it is, 0..1.
            timeout_s: time for all of it.
            options: pages to use, and model to replace; see `RecalibrationOptions`.

        Raises:
            RecalibrationRefusedError: the new model would not be better; the old one stays.
            BusyError: another recalibration runs; its `job` says which.
            OtherModelError: another model is in service than was expected.
            JobCancelledError: somebody has cancelled it.
            LimitError: more pages than the service takes.
            InvalidInputError: no such pages or recording, too few pages, the same one twice, or unknown symbols.
            SourceError: the service has no source or recordings, or damaged ones, or no symbols of its own pages.
            StoppingError: the service is being stopped.
            BundleError: the new model cannot be written or noted; the old one stays.
        """
        result = None
        with self._replies("Recalibrate", timeout_s=timeout_s, **_fields(options)) as replies:
            for reply in replies:  # to its end: a call that is left early counts as cancelled
                if reply.HasField("result"):
                    result = answer_of(Recalibrated, reply.result)
                else:
                    progress(reply.progress.step, reply.progress.fraction)
        if result is None:
            got, expected = "an end without a result", "a recalibration's result"
            raise LightpageError(f"service at {self._connection.target}", got, expected)
        return result

    def start(self, *, correlation_id: str = "", **options: Unpack[RecalibrationOptions]) -> JobInfo:
        """Start a recalibration and return its job at once; it goes on by itself, see `watch`.

        Args:
            correlation_id: a text that the job carries.
            options: as for `recalibrate`.

        Raises:
            BusyError: another recalibration runs; its `job` says which.
            OtherModelError: another model is in service than was expected.
            LimitError: more pages than the service takes.
            InvalidInputError: no such recording.
            SourceError: the service has no source or recordings.
        """
        return job_info(self._ask("StartRecalibration", correlation_id=correlation_id, **_fields(options)))

    def start_with_frames(
        self,
        pairs: Sequence[FramePair],
        symbols: Sequence[NDArray[np.uint8]],
        references: FramePair,
        *,
        levels: int,
        bit_depth: int | None = None,
        black_level: int = 0,
        pilot_mask: NDArray[np.bool_] | None = None,
        expected_version: str = "",
        correlation_id: str = "",
        timeout_s: float = DATA_S,
    ) -> JobInfo:
        """Send pages with known symbols, start a recalibration with them, which goes on by itself, and return its job.

        Args:
            pairs: frame pairs, one a page.
            symbols: what was written, [ny, nx], one a page.
            references: reference-only frames taken with them.
            levels: M of the symbols.
            bit_depth: bits of a camera count; by default those of the service's camera.
            black_level: counts that the cameras add to every pixel.
            pilot_mask: where the pilots are, [ny, nx]; None for the device's own.
            expected_version: version that must be in service; empty for any.
            correlation_id: as for `start`.
            timeout_s: time for sending it all.

        Raises:
            FrameError: frames that cannot be sent, or that the service refuses.
            PageError: symbols or pilots that do not fit the page, or an impossible level count.
            BusyError: another recalibration runs; its `job` says which.
            OtherModelError: another model is in service than was expected.
            LimitError: more pages than the service takes.
            InvalidInputError: too few pages, the same one twice, or not as many symbols as pairs.
        """
        if len(pairs) != len(symbols):
            got = f"{len(pairs)} frame pairs and {len(symbols)} pages of symbols"
            raise InvalidInputError("pages to recalibrate with", got, "as many of both")
        first = sent_frames(references, "reference: ")
        header = message_of(
            pb.RecalibrateFramesHeader,
            **format_of(first[0]),
            bit_depth=self._connection.description.bit_depth if bit_depth is None else bit_depth,
            black_level=black_level,
            levels=levels,
            pages=len(pairs),
            pilot_mask=None if pilot_mask is None else np.asarray(pilot_mask, bool),
            expected_version=expected_version,
            correlation_id=correlation_id,
        )
        pages = [
            (sent_frames(pair, f"known page {number}: ", first[0]), sent_symbols(page, f"known page {number}: symbols"))
            for number, (pair, page) in enumerate(zip(pairs, symbols, strict=True))
        ]

        def parts() -> Iterator[pb.RecalibrateFramesRequest]:
            yield pb.RecalibrateFramesRequest(header=header)
            for chunk in map(bytes, chunks_of(first)):
                yield pb.RecalibrateFramesRequest(reference=chunk)
            for frames, page in pages:
                yield pb.RecalibrateFramesRequest(symbols=page)
                for chunk in map(bytes, chunks_of(frames)):
                    yield pb.RecalibrateFramesRequest(chunk=chunk)

        return job_info(self._ask("RecalibrateFrames", parts(), timeout_s))

    def list(self) -> Sequence[JobInfo]:
        """Return the jobs that run, and those that ended lately, the newest first.

        Raises:
            LightpageError: no answer.
        """
        reply: pb.ListJobsReply = self._ask("ListJobs")
        return [job_info(job) for job in reply.jobs]

    def get(self, job_id: str) -> JobInfo:
        """Return a job as it is now.

        Raises:
            NoSuchJobError: there is no such job, or it ended long ago.
        """
        return job_info(self._ask("GetJob", id=job_id))

    def watch(self, job_id: str, timeout_s: float = RECALIBRATION_S) -> Iterator[JobInfo]:
        """Yield a job as it is now, and at each change, until it has ended.

        A connection that is lost on the way, or a service that starts again, is waited for.

        Raises:
            NoSuchJobError: there is no such job, or it ended long ago.
            LightpageError: no answer at all, or the job has not ended within `timeout_s`; it goes on.
        """
        clock = self._connection.clock
        until, last = clock.now() + timeout_s, None
        while True:
            left_s = until - clock.now()
            call = self._connection.call("WatchJob", None, max(0.0, min(left_s, _WATCH_S)), id=job_id)
            try:
                for job in call:
                    if job != last:
                        last = job
                        yield job_info(job)
                    if job.state != pb.JOB_STATE_RUNNING:
                        return
            except grpc.RpcError as error:
                if last is None or clock.now() >= until or not is_lost_connection(error):
                    raise error_of(error, self._connection.target) from None
            finally:
                call.cancel()
            clock.sleep(max(0.0, min(_AGAIN_S, until - clock.now())))

    def cancel(self, job_id: str) -> JobInfo:
        """Have a job end at its next step; return it as it is then. One that has ended stays as it is.

        Raises:
            NoSuchJobError: there is no such job, or it ended long ago.
        """
        return job_info(self._ask("CancelJob", id=job_id))


def _fields(options: RecalibrationOptions) -> dict[str, Any]:
    """Return options as the fields of a request.

    Raises:
        InvalidInputError: pages both of the source and of a recording.
    """
    asked: dict[str, Any] = dict(options)
    count, pages, recording = asked.pop("count", 0), asked.pop("pages", ()), asked.pop("recording", None)
    if recording is not None:
        if pages:
            got = f"{recording!r} and pages {[*pages]} of the source"
            raise InvalidInputError(
                "pages to recalibrate with", got, "one of both; `count` takes a recording's first ones"
            )
        return asked | {"recording": recording, "recording_count": count}
    return asked | {"source": message_of(pb.SourcePages, count=count, pages=pages)}
