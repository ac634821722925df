"""Recalibrations as jobs: the one that runs, those that have ended, and a file that outlives the service."""

from __future__ import annotations

import json
import logging
import os
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from google.protobuf import json_format

from lightpage.errors import (
    BusyError,
    CalibrationError,
    CallerLeft,
    JobCancelledError,
    LightpageError,
    NoSuchJobError,
    RecalibrationRefusedError,
    StoppingError,
)
from lightpage.files import replace_text
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.status import refusal_of
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.jobs.messages import result_message
from lightpage.runtime.service.limits import JOBS_KEPT

_log = logging.getLogger(__name__)

FILE = "jobs.json"
DAMAGED = "jobs.damaged.json"
"""What could not be read is set aside under this name; an earlier such file is replaced."""

_FORMAT, _VERSION = "lightpage-jobs", 1


@dataclass(eq=False)
class RunningJob:
    """The job that runs, as whoever works on it sees it.

    Attributes:
        id: of the job.
        caller: on whose behalf it waits for slots; leaves when the job is to end.
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

    With a folder, a job's begin and its end are on the disk before anybody hears of them. A disk that cannot be written
    costs the record, which is logged, and not the job.

    Args:
        folder: where `jobs.json` is kept, or None: then a restart forgets all jobs.
        kept: ended jobs that are kept.
        version: of the model in service: by it a job is known whose service ended while it put its model in service.
        clock: seconds since 1970.
    """

    def __init__(
        self,
        folder: Path | None = None,
        kept: int = JOBS_KEPT,
        version: str = "",
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._path, self._kept, self._clock = None if folder is None else folder / FILE, kept, clock
        self._lock = threading.Lock()
        """Guards the list and the running job; never held while the file is written."""
        self._running: RunningJob | None = None
        self._idle = threading.Event()
        self._idle.set()
        self._jobs: list[pb.Job] = []
        """The oldest first. Only `begin` and `end` change it, and they follow each other: no two write the file."""
        if self._path is not None:
            self._jobs = _ended_by_restart(_read(self._path), version, clock())[-kept:]
            if self._jobs:
                self._write(self._jobs)

    def begin(self, pages_of: str, caller: Caller, correlation_id: str = "") -> RunningJob:
        """Note that a job begins; it must be ended.

        Args:
            pages_of: where its pages come from, for people.
            caller: on whose behalf it runs; made to leave when it is cancelled.
            correlation_id: the caller's own text.

        Raises:
            BusyError: another one runs; its `job` says which.
        """
        with self._lock:
            self._check_free()
            running = RunningJob(secrets.token_hex(6), caller)
            job = pb.Job(
                id=running.id,
                state=pb.JOB_STATE_RUNNING,
                progress=pb.Progress(step="begin"),
                created_s=self._clock(),
                correlation_id=correlation_id,
                pages_of=pages_of,
            )
            self._jobs = [*self._jobs, job]
            self._running = running
            self._idle.clear()
        self._write(self._jobs)
        return running

    def check_free(self) -> None:
        """See whether one may begin now.

        Raises:
            BusyError: another one runs.
        """
        with self._lock:
            self._check_free()

    def _check_free(self) -> None:
        if self._running is not None:
            got = f"one that is running, job {self._running.id}"
            busy = BusyError("recalibration", got, "one at a time; try again when it has ended")
            busy.job = self._running.id
            raise busy

    def tell(self, step: str, fraction: float) -> None:
        """Note how far the running job is."""
        with self._lock:
            self._jobs[-1].progress.CopyFrom(pb.Progress(step=step, fraction=fraction))

    def foretell(self, outcome: RecalibrationOutcome) -> None:
        """Note what the running job has found, before its model is put in service.

        Should the service end in between, its next start knows by the model in service whether it was.
        """
        with self._lock:
            *earlier, running = self._jobs
            found = _copy(running)
        found.result.CopyFrom(result_message(outcome))
        self._write([*earlier, found])

    def end(self, running: RunningJob, end: RecalibrationOutcome | BaseException) -> None:
        """Note how the running job has ended; the next one may begin."""
        with self._lock:
            *earlier, job = self._jobs
            ended = _copy(job)
        try:
            ended.ended_s, ended.state = self._clock(), _state(end)
            if isinstance(end, RecalibrationOutcome):
                ended.result.CopyFrom(result_message(end))
            else:
                ended.refusal.CopyFrom(refusal_of(end))
                unforeseen = None if isinstance(end, LightpageError | CallerLeft) else end
                told = logging.INFO if unforeseen is None else logging.ERROR
                _log.log(told, "recalibration: job %s ended: %s", running.id, end, exc_info=unforeseen)
            self._write([*earlier, ended][-self._kept :])
        except Exception:  # whoever works on the job must hear of its end whatever its record says
            _log.exception("jobs: the end of job %s is not noted", running.id)
        finally:
            with self._lock:
                self._jobs, self._running = [*earlier, ended][-self._kept :], None
            self._idle.set()

    def cancel(self, id_: str) -> None:
        """Have a job end at its next step; one that has ended stays as it is.

        Raises:
            NoSuchJobError: there is none of this id.
        """
        with self._lock:
            self._find(id_)
            running = self._running
            if running is None or running.id != id_:
                return
            running.cancelled = True
        running.caller.leave()

    def job(self, id_: str) -> pb.Job:
        """A job as it is now.

        Raises:
            NoSuchJobError: there is none of this id.
        """
        with self._lock:
            return _copy(self._find(id_))

    def all(self) -> list[pb.Job]:
        """All jobs that are kept, the newest first."""
        with self._lock:
            return [_copy(job) for job in reversed(self._jobs)]

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until no job runs; whether that is so."""
        return self._idle.wait(timeout_s)

    def _find(self, id_: str) -> pb.Job:
        for job in self._jobs:
            if job.id == id_:
                return job
        raise NoSuchJobError("job", repr(id_), f"one that runs, or one of the {self._kept} that ended last")

    def _write(self, jobs: list[pb.Job]) -> None:
        if self._path is None:
            return
        entries = [json_format.MessageToDict(job, preserving_proto_field_name=True) for job in jobs]
        try:
            replace_text(self._path, json.dumps({"format": _FORMAT, "version": _VERSION, "jobs": entries}), "jobs")
        except LightpageError as error:
            _log.warning("jobs: a restart will know less of them: %s", error)


def _copy(job: pb.Job) -> pb.Job:
    copy = pb.Job()
    copy.CopyFrom(job)
    return copy


def _state(end: RecalibrationOutcome | BaseException) -> pb.JobState:
    if isinstance(end, RecalibrationOutcome):
        return pb.JOB_STATE_DONE
    if isinstance(end, RecalibrationRefusedError | CalibrationError):
        return pb.JOB_STATE_REFUSED
    if isinstance(end, JobCancelledError | CallerLeft):
        return pb.JOB_STATE_CANCELLED
    return pb.JOB_STATE_INTERRUPTED if isinstance(end, StoppingError) else pb.JOB_STATE_FAILED


def _read(path: Path) -> list[pb.Job]:
    """The jobs that a file tells of; one that cannot be read is set aside, and tells of none."""
    try:
        noted = json.loads(path.read_text("utf-8"))
        if (noted["format"], noted["version"]) != (_FORMAT, _VERSION):
            raise ValueError(f"{noted['format']!r} of version {noted['version']!r}")
        jobs = [json_format.ParseDict(entry, pb.Job(), ignore_unknown_fields=True) for entry in noted["jobs"]]
        if not all(job.id for job in jobs):
            raise ValueError("a job without an id")
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, json_format.Error) as error:
        _log.warning(
            "jobs of earlier are forgotten: %s cannot be read, and is set aside as %s: %r", path, DAMAGED, error
        )
        try:
            os.replace(path, path.with_name(DAMAGED))
        except OSError as other:
            _log.warning("%s stays where it is: %s", path, other)
        return []
    return jobs


def _ended_by_restart(jobs: list[pb.Job], version: str, now_s: float) -> list[pb.Job]:
    """The jobs, those that ran when the service ended now as they are: cut off, or done but for their note."""
    for job in jobs:
        if job.state != pb.JOB_STATE_RUNNING:
            continue
        job.ended_s = now_s
        if job.HasField("result") and job.result.model_version == version:
            job.state = pb.JOB_STATE_DONE
            continue
        job.state = pb.JOB_STATE_INTERRUPTED
        job.ClearField("result")
        cut_off = StoppingError("recalibration", "the end of the service", "one that serves; nothing was changed")
        job.refusal.CopyFrom(refusal_of(cut_off))
    return jobs
