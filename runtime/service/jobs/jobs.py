"""Recalibrations as jobs: the one that runs, and those that have ended, which the store remembers."""

import logging
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from google.protobuf.message import DecodeError

from lightpage.errors import (
    BusyError,
    CalibrationError,
    CallerLeft,
    JobCancelledError,
    LightpageError,
    NoSuchJobError,
    RecalibrationRefusedError,
    StoppingError,
    StoreError,
)
from lightpage.runtime.client.answers import job_info
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.status import refusal_of
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.jobs.messages import result_message
from lightpage.runtime.service.limits import JOBS_KEPT
from lightpage.runtime.service.models.database import Write, write_job
from lightpage.runtime.service.models.store import Store

_log = logging.getLogger(__name__)


@dataclass(eq=False)
class RunningJob:
    """The job that runs, as whoever works on it sees it.

    Attributes:
        id: id of the job.
        caller: caller on whose behalf it waits for slots; leaves when the job is to end.
        cancelled: whether somebody has cancelled it.
    """

    id: str
    caller: Caller
    cancelled: bool = False

    def check(self) -> None:
        """Go on only where nobody wants it to end.

        Raises:
            JobCancelledError: somebody has cancelled it.
            CallerLeft: whoever it belongs to has gone.
        """
        if self.cancelled:
            raise JobCancelledError("recalibration", f"job {self.id} was cancelled", "one that goes on")
        self.caller.check()


class Jobs:
    """Keeps the running job and those that have ended. Every method may be called from many threads.

    A job's begin and its end are in the store before anybody hears of them. A disk that cannot be written costs the
    record, which is logged, and not the job.

    Args:
        store: remembers jobs; those that ran when the service before ended are interrupted now.
        kept: jobs that are kept.
        clock: seconds since 1970.
    """

    def __init__(self, store: Store, kept: int = JOBS_KEPT, clock: Callable[[], float] = time.time) -> None:
        self._store, self._kept, self._clock = store, kept, clock
        self._running: RunningJob | None = None
        self._idle = threading.Event()
        self._idle.set()
        self._jobs: dict[str, pb.Job] = {}
        """By id, the oldest first; the mapping and its messages are replaced and never changed."""
        try:
            earlier = [pb.Job.FromString(message) for message in store.contents.jobs.values()]
        except DecodeError as error:
            _log.warning("jobs of earlier are forgotten: %s", error)
            earlier = []
        for job in earlier[-kept:]:
            self._jobs[job.id] = job
            if job.state == pb.JOB_STATE_RUNNING:
                end = StoppingError("recalibration", "the end of the service", "one that serves; nothing was changed")
                self._keep(self._ended(job, end))

    def begin(self, pages_of: str, caller: Caller, correlation_id: str = "") -> RunningJob:
        """Note that a job begins; it must be ended.

        Args:
            pages_of: where its pages come from, for people.
            caller: caller on whose behalf it runs; made to leave when it is cancelled.
            correlation_id: the caller's own text.

        Raises:
            BusyError: another one runs; its `job` says which.
        """
        with self._store.changing:
            self.check_free()
            running = RunningJob(secrets.token_hex(6), caller)
            job = pb.Job(id=running.id, state=pb.JOB_STATE_RUNNING, created_s=self._clock(), pages_of=pages_of)
            job.correlation_id, job.progress.step = correlation_id, "begin"
            self._keep(job)
            self._running = running  # whoever hears of it now finds it
            self._idle.clear()
        return running

    def check_free(self) -> None:
        """See whether one may begin now.

        Raises:
            BusyError: another one runs.
        """
        if (running := self._running) is not None:
            got = f"one that is running, job {running.id}"
            busy = BusyError("recalibration", got, "one at a time; try again when it has ended")
            busy.job = running.id
            raise busy

    def tell(self, running: RunningJob, step: str, fraction: float) -> None:
        """Note how far the running job is."""
        told = pb.Job()
        told.CopyFrom(self._jobs[running.id])
        told.progress.CopyFrom(pb.Progress(step=step, fraction=fraction))
        self._jobs = {**self._jobs, running.id: told}

    def done(self, running: RunningJob, outcome: RecalibrationOutcome) -> Write:
        """Return what writes that a job is done, to be written with its model."""
        return self._written(self._ended(self._jobs[running.id], outcome))

    def end(self, running: RunningJob, end: RecalibrationOutcome | BaseException) -> None:
        """Note how the running job has ended; the next one may begin."""
        if not isinstance(end, RecalibrationOutcome):
            unforeseen = None if isinstance(end, LightpageError | CallerLeft) else end
            told = logging.INFO if unforeseen is None else logging.ERROR
            _log.log(told, "recalibration: job %s ended: %s", running.id, end, exc_info=unforeseen)
        try:
            ended = self._ended(self._jobs[running.id], end)
            self._keep(ended)
            if (result := job_info(ended).result) is not None:
                _log.info("recalibration: job %s ended: %s", running.id, result.told)
        finally:
            self._running = None
            self._idle.set()

    def cancel(self, id_: str) -> None:
        """Have a job end at its next step; one that has ended stays as it is.

        Raises:
            NoSuchJobError: there is none of this id.
        """
        self.job(id_)
        if (running := self._running) is not None and running.id == id_:
            running.cancelled = True
            running.caller.leave()

    def job(self, id_: str) -> pb.Job:
        """Return a job as it is now.

        Raises:
            NoSuchJobError: there is none of this id.
        """
        if (job := self._jobs.get(id_)) is None:
            raise NoSuchJobError("job", repr(id_), f"one that runs, or one of the {self._kept} that ended last")
        return job

    def all(self) -> list[pb.Job]:
        """Return all jobs that are kept, the newest first."""
        return list(self._jobs.values())[::-1]

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until no job runs; whether that is so."""
        return self._idle.wait(timeout_s)

    def _ended(self, job: pb.Job, end: RecalibrationOutcome | BaseException) -> pb.Job:
        ended = pb.Job()
        ended.CopyFrom(job)
        ended.ended_s, ended.state = self._clock(), _state(end)
        try:
            if isinstance(end, RecalibrationOutcome):
                ended.result.CopyFrom(result_message(end))
            else:
                ended.ClearField("result")
                ended.refusal.CopyFrom(refusal_of(end))
        except Exception:  # whoever works on the job must hear of its end whatever its record says
            _log.exception("jobs: the end of job %s is not noted", job.id)
        return ended

    def _written(self, job: pb.Job) -> Write:
        return partial(write_job, id_=job.id, message=job.SerializeToString(), kept=self._kept)

    def _keep(self, job: pb.Job) -> None:
        """Write a job to the store, then show it; the oldest beyond those that are kept are forgotten."""
        try:
            with self._store.transaction() as database:
                self._written(job)(database)
        except StoreError as error:
            _log.warning("jobs: a restart will know less of them: %s", error)
        self._jobs = dict([*(self._jobs | {job.id: job}).items()][-self._kept :])


def _state(end: RecalibrationOutcome | BaseException) -> pb.JobState:
    if isinstance(end, RecalibrationOutcome):
        return pb.JOB_STATE_DONE
    if isinstance(end, RecalibrationRefusedError | CalibrationError):
        return pb.JOB_STATE_REFUSED
    if isinstance(end, JobCancelledError | CallerLeft):
        return pb.JOB_STATE_CANCELLED
    return pb.JOB_STATE_INTERRUPTED if isinstance(end, StoppingError) else pb.JOB_STATE_FAILED
