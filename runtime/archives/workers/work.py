"""Work of a worker on a range: a warm decoder reads its pages in order and writes the shard."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cached_property

from lightpage.errors import BundleError, RecordingError, StorageError
from lightpage.failures import may_pass, os_errors, understood
from lightpage.recording.joined import join
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import check_recording
from lightpage.runtime.archives.recordings.page_reader import Healings
from lightpage.runtime.archives.run.job import bundle_sha256
from lightpage.runtime.archives.run.shard import Findings, ShardRecord
from lightpage.runtime.archives.run.task import Choices, Done, Failed, NamedBundle, Outcome, Problem, Stamp, Step, Task
from lightpage.runtime.archives.workers.device import recalibrated
from lightpage.runtime.archives.workers.fine_tuning import DeepRecalibration, deep_recalibration
from lightpage.runtime.archives.workers.page_range import PageRange, lost_page
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import NoTracker, Tracker
from lightpage.runtime.model.execution.providers import Provider
from lightpage.runtime.recalibration.recalibration import Refit
from lightpage.runtime.recalibration.refit import refit


class Worker:
    """Reads ranges one after the other; the decoder of the last one's bundle stays warm.

    Args:
        threads: number of threads of an inference.
        fit: how a device is re-fitted.
        deep: gives what recalibrates deeply.

    Attributes:
        tell: called with the step that a deep recalibration is at.
    """

    def __init__(
        self, threads: int, fit: Refit = refit, deep: Callable[[], DeepRecalibration] = deep_recalibration
    ) -> None:
        self._threads, self._fit, self._deep = threads, fit, deep
        self.tell: Callable[[Step], None] = lambda step: None
        self._warm: tuple[NamedBundle, Choices, _Warm] | None = None

    def work(self, task: Task) -> Outcome:
        """Read a range and write its shard, or say why there is none.

        Errors that nobody foresaw are raised: they end the worker, and the range goes to another one.
        """
        start, read_bytes = time.perf_counter(), 0
        opened = read = opening = False
        try:
            warm = self._opened(task.bundle, task.choices)
            opening = True
            _check_stamp(task)
            with _recording_of(task) as recording:
                check_recording(warm.decoder, recording)
                opened, opening = True, False
                found = self._findings(task, recording, warm)
                read_bytes = round(recording.stored_page_bytes * min(len(task.pages), recording.pages))
            read = True
            _check_stamp(task)
            return _written(task, found, start, read_bytes)
        except Exception as error:
            failure = understood(task.name, error)
            if failure is None:
                raise
            if not (task.give_up and opening and isinstance(failure, StorageError | RecordingError)):
                whole = not read and not (opened and may_pass(failure))
                return Failed(task=task, problem=Problem.of(failure), whole_recording=whole)
            return _written(task, Findings(pages=tuple(lost_page(page, failure) for page in task.pages)), start, 0)

    def _findings(self, task: Task, recording: Recording, warm: _Warm) -> Findings:
        if task.recalibrates:
            return recalibrated(task, recording, warm.decoder, self._fit, self._deep, self.tell)
        tracker = warm.tracker.anew() if task.choices.tracking else NoTracker(warm.decoder)
        return PageRange(task, recording, warm.decoder, tracker, warm.healings_of(task.device)).findings()

    def _opened(self, bundle: NamedBundle, choices: Choices) -> _Warm:
        """The decoder of a bundle; the one before it is let go first, so that there is one at a time.

        Raises:
            BundleError: another bundle than was named.
            ProviderError: there is no such provider here.
        """
        provider, batching = Provider.parse(choices.provider), Batching(choices.batches)
        if self._warm is None or self._warm[:2] != (bundle, choices):
            self._warm = None
            if (found := bundle_sha256(bundle.path)) != bundle.sha256:
                raise BundleError(f"bundle {bundle.path}", f"SHA-256 {found}", f"{bundle.sha256}, as at the start")
            decoder = Decoder(
                Bundle.open(bundle.path),
                self._threads,
                provider=provider,
                code_threads=choices.code_threads,
                batching=batching,
                steps=choices.steps,
            )
            self._warm = bundle, choices, _Warm(decoder)
        return self._warm[2]


class _Warm:
    """A decoder, a tracker of which each range gets one that has learnt nothing, and the last device's healings."""

    def __init__(self, decoder: Decoder) -> None:
        self.decoder = decoder
        self._healings = "", Healings()

    def healings_of(self, device: str) -> Healings:
        """The healings of a device; those of another one, whose model takes memory, are forgotten."""
        if self._healings[0] != device:
            self._healings = device, Healings()
        return self._healings[1]

    @cached_property
    def tracker(self) -> Tracker:
        return tracker_for(self.decoder)


def _written(task: Task, found: Findings, start: float, read_bytes: int) -> Done:
    """A range whose record is written; `start` is when it was begun, `time.perf_counter` seconds."""
    record = ShardRecord(
        **vars(found),
        model=task.bundle,
        seconds=time.perf_counter() - start,
        finished_s=time.time(),
        worker=f"{socket.gethostname()}:{os.getpid()}",
        read_bytes=read_bytes,
    )
    record.write(task.shard)
    return Done(task=task, lost=found.lost, left_out=found.left_out, seconds=record.seconds, read_bytes=read_bytes)


@contextmanager
def _recording_of(task: Task) -> Iterator[Recording]:
    """The recording of a task, or its recordings as one.

    Raises:
        RecordingError: see `Recording.open` and `join`.
    """
    with ExitStack() as stack:
        path = task.recording
        if len(task.files) > 1:
            path = task.shard.with_name(f".{task.shard.name}-joined.h5")  # swept where the worker is killed
            stack.callback(path.unlink, missing_ok=True)
            join([file.path for file in task.files], path)
        yield stack.enter_context(Recording.open(path))


def _check_stamp(task: Task) -> None:
    """Check that recordings are those that the run began with.

    Raises:
        RecordingError: one has gone or has changed.
    """
    for file in task.files:
        subject = f"recording {file.path}"
        with os_errors(subject, "the file that the run began with", RecordingError):
            found = Stamp.of(file.path)
        if found != file.stamp:
            expected = f"{file.stamp.size} bytes, changed when the run began: begin another run with the new file"
            raise RecordingError(subject, f"{found.size} bytes, changed since", expected)
