"""What a worker does with a range: a warm decoder reads its pages in order and writes the shard."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.known_pages import first_lit_pages
from lightpage.codec.page_bytes import Loss, PageBytes
from lightpage.codec.volume import Volume
from lightpage.errors import (
    BundleError,
    CalibrationError,
    FrameError,
    InvalidInputError,
    LightpageError,
    LostPageError,
    RecalibrationRefusedError,
    RecordingError,
    StorageError,
)
from lightpage.failures import may_pass, os_failure, understood
from lightpage.metrics.accumulator import Accumulator
from lightpage.metrics.measures import PageMeasures, measure
from lightpage.page.pilots import Pilots
from lightpage.progress import reporting, warn
from lightpage.recording.decoded_file import DecodedWriter
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.joined import join
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import check_recording, decode_unseen, pilots_of
from lightpage.runtime.archives.recordings.read_ahead import read_ahead
from lightpage.runtime.archives.recordings.recovery import RecoveredPage, code_of, page_reader, read_page, unread_page
from lightpage.runtime.archives.run.job import bundle_sha256
from lightpage.runtime.archives.run.shard import (
    BUNDLE,
    LOG,
    SYMBOLS,
    TRAINING,
    PageRecord,
    PageState,
    ShardRecord,
    with_end,
    write_user_bytes,
)
from lightpage.runtime.archives.run.steps import StepLog
from lightpage.runtime.archives.run.task import (
    Done,
    Failed,
    NamedBundle,
    Operation,
    Outcome,
    Problem,
    Stamp,
    Step,
    Task,
)
from lightpage.runtime.archives.workers.fine_tuning import DeepRecalibration, deep_recalibration
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import NoTracker, Tracker
from lightpage.runtime.model.execution.providers import Provider
from lightpage.runtime.recalibration.known_pages import read_recorded
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, Refit, next_version, recalibrate
from lightpage.runtime.recalibration.refit import refit

T = TypeVar("T")


_OF_THE_DEVICE = (RecalibrationRefusedError, CalibrationError, FrameError)
"""What a deep recalibration finds of a device; anything else is tried again by the next run."""


class Changed(RecordingError):
    """A recording that is not the one that the run began with."""


class Worker:
    """Reads ranges one after the other; the decoder of the last one's bundle stays warm.

    Args:
        threads: of an inference.
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
        self._warm: tuple[NamedBundle, str, _Warm] | None = None

    def work(self, task: Task) -> Outcome:
        """Read a range and write its shard, or say why there is none.

        Errors that nobody foresaw are raised: they end the worker, and the range goes to another one.
        """
        start = time.perf_counter()
        opened = read = opening = False
        try:
            warm = self._opened(task.bundle, task.provider)
            opening = True
            _check_stamp(task)
            with _recording_of(task) as recording:
                check_recording(warm.decoder, recording)
                opened, opening = True, False
                record = self._record(task, recording, warm)
                read_bytes = round(recording.stored_page_bytes * min(len(task.pages), recording.pages))
            read = True
            _check_stamp(task)
            record = record.model_copy(update=self._told(start, read_bytes))
            record.write(task.shard)
        except Exception as error:
            failure = understood(task.name, error)
            if failure is None:
                raise
            if not (task.give_up and opening and isinstance(failure, StorageError | RecordingError)):
                whole = not read and not (opened and may_pass(failure))
                return Failed(task=task, problem=Problem.of(failure), whole_recording=whole)
            lost = tuple(lost_page(page, failure) for page in task.pages)
            record = ShardRecord(model=task.bundle, pages=lost, seconds=0.0, finished_s=time.time())
            record.write(task.shard)
        return Done(
            task=task,
            lost=record.lost,
            left_out=record.left_out,
            seconds=record.seconds,
            read_bytes=record.read_bytes,
        )

    @staticmethod
    def _told(start: float, read_bytes: int) -> dict[str, float | int | str]:
        """Who has done a range since a `time.perf_counter` moment, and when."""
        return {
            "seconds": time.perf_counter() - start,
            "finished_s": time.time(),
            "worker": f"{socket.gethostname()}:{os.getpid()}",
            "read_bytes": read_bytes,
        }

    def _record(self, task: Task, recording: Recording, warm: _Warm) -> ShardRecord:
        if task.operation is Operation.RECALIBRATE:
            return self._recalibrated(task, recording, warm.decoder)
        tracker = warm.tracker.anew() if task.tracking else NoTracker(warm.decoder)
        reading = _Range(task, recording, warm.decoder, tracker)
        return {
            Operation.DECODE: reading.decoded,
            Operation.EVALUATE: reading.evaluated,
            Operation.RECOVER: reading.recovered,
        }[task.operation]()

    def _opened(self, bundle: NamedBundle, provider: str) -> _Warm:
        """The decoder of a bundle; the one before it is let go first, so that there is one at a time.

        Raises:
            BundleError: another bundle than was named.
            ProviderError: there is no such provider here.
        """
        if self._warm is None or self._warm[:2] != (bundle, provider):
            self._warm = None
            if (found := bundle_sha256(bundle.path)) != bundle.sha256:
                raise BundleError(
                    f"bundle {bundle.path}", f"SHA-256 {found}", f"{bundle.sha256}, as the run began with"
                )
            self._warm = bundle, provider, _Warm(Decoder.load(bundle.path, self._threads, Provider.parse(provider)))
        return self._warm[2]

    def _recalibrated(self, task: Task, recording: Recording, decoder: Decoder) -> ShardRecord:
        """Recalibrate a device; that its pages fit no geometry is a result too."""
        out = with_end(task.shard, BUNDLE)
        out.unlink(missing_ok=True)  # of a worker that was killed before it wrote the record
        try:
            if task.fine_tuning is not None:
                outcome = self._fine_tuned(task, recording, decoder)
            else:
                known = read_recorded(recording, first_lit_pages(recording, len(task.pages), warn))
                outcome = recalibrate(decoder, known, out, next_version(decoder.version), self._fit, lambda *_: None)
        except (RecalibrationRefusedError, CalibrationError, InvalidInputError) as error:
            if task.fine_tuning is not None and not isinstance(error, _OF_THE_DEVICE):
                raise
            lost = PageRecord(page=0, state=PageState.LOST, loss=type(error).__name__, reason=str(error))
            return ShardRecord(model=task.bundle, pages=(lost,), seconds=0.0)
        read = PageRecord(page=0, state=PageState.READ)
        return ShardRecord(model=task.bundle, pages=(read,), seconds=0.0, summary=_summary(outcome))

    def _fine_tuned(self, task: Task, recording: Recording, decoder: Decoder) -> RecalibrationOutcome:
        """Recalibrate a device deeply, or go on where an earlier run was ended."""
        assert task.fine_tuning is not None  # or it would be re-fitted
        if task.run is None:
            raise InvalidInputError(f"device {task.device}", "no run", "the training run that its bundle was made from")
        log = StepLog(
            with_end(task.shard, LOG), lambda what: self.tell(Step(device=task.device or task.name, what=what))
        )
        with reporting(log):
            return self._deep().recalibrate(
                decoder,
                recording,
                task.run,
                with_end(task.shard, TRAINING),
                with_end(task.shard, BUNDLE),
                task.fine_tuning,
                len(task.pages),
                log.progress,
            )


class _Warm:
    """A decoder, and a tracker of which each range gets one that has learnt nothing."""

    def __init__(self, decoder: Decoder) -> None:
        self.decoder = decoder

    @cached_property
    def tracker(self) -> Tracker:
        return tracker_for(self.decoder)


@dataclass(frozen=True)
class _Range:
    """The pages of a range on their way."""

    task: Task
    recording: Recording
    decoder: Decoder
    tracker: Tracker

    @property
    def _findings(self) -> tuple[type[LightpageError], ...]:
        """Errors that are what becomes of a page; any other leaves the range without a result."""
        return (InvalidInputError, LostPageError, *([StorageError] if self.task.give_up else []))

    def decoded(self) -> ShardRecord:
        """Symbols, confidences, and figures where the symbols are known."""
        levels, mask = self.recording.levels, pilots_of(self.decoder, self.recording)
        records: list[PageRecord] = []

        def decode(frames: FramePair, symbols: NDArray[np.uint8] | None) -> DecodedPage:
            pilots = self.decoder.pilots(levels, mask) if symbols is None else Pilots.of_symbols(mask, symbols, levels)
            return self.tracker.decode(narrow(frames, self.recording.bit_depth), levels, pilots)

        def read(append: Callable[[_Page], None] | None) -> None:
            for page, shown in self._read(self.recording.shown):
                try:
                    frames, symbols = shown.result()
                    found = decode(frames, symbols)
                except self._findings as error:
                    records.append(lost_page(page, error))
                    continue
                if append is not None:
                    append(_Page(found.symbols, found.confidence, self.decoder.version, page))
                figures = None if symbols is None else _measured(found, symbols, ~mask)
                records.append(_read_record(page, found, figures))

        if self.task.symbols:
            with DecodedWriter(with_end(self.task.shard, SYMBOLS), levels) as writer:
                read(writer.append)
        else:
            read(None)
        return self._shard(records)

    def evaluated(self) -> ShardRecord:
        """Figures of the pages that the bundle has not seen.

        Raises:
            RecordingError: the recording has no symbols.
        """
        if not self.recording.has_symbols:
            expected = "known symbols to measure against"
            raise RecordingError(f"recording {self.recording.path}", "no symbols", expected)
        mask = pilots_of(self.decoder, self.recording)
        accumulator = Accumulator(self.recording.levels, ~mask, len(self.task.pages))
        records: list[PageRecord] = []
        for page, shown in self._read(self.recording.shown):
            try:
                frames, symbols = shown.result()
                found = decode_unseen(self.decoder, self.recording, self.tracker, mask, frames, symbols)
            except self._findings as error:
                records.append(lost_page(page, error))
                continue
            if found is None or symbols is None:
                records.append(PageRecord(page=page, state=PageState.LEFT_OUT))
                continue
            accumulator.add(found.phase[~mask], found.concentration[~mask], symbols[~mask])
            records.append(_read_record(page, found, accumulator.pages[-1]))
        record = self._shard(records)
        return record.model_copy(update={"confidence_bins": tuple(accumulator.confidence_bins())})

    def recovered(self) -> ShardRecord:
        """User bytes."""
        code = self.task.code or code_of(self.recording, self.decoder.bundle)
        reader = page_reader(self.decoder, self.recording, self.tracker, code)
        kept: list[tuple[int, PageBytes]] = []
        records: list[PageRecord] = []
        for page, shown in self._read(self.recording.shown):

            def take(found: PageBytes, page: int = page) -> Volume | None:
                volume = Volume.of_page(found)
                if volume is not None:
                    kept.append((page, found))
                return volume

            try:
                found = read_page(reader, self.recording.bit_depth, page, shown, take)
            except StorageError as error:
                if not self.task.give_up:
                    raise
                found = unread_page(reader, page, Loss.STORAGE, error)
            records.append(_recovered_record(found))
        write_user_bytes(self.task.shard, kept)
        return self._shard(records)

    def _read(self, read: Callable[[int], T]) -> Iterator[tuple[int, Future[T]]]:
        pages = self.task.pages
        for index, future in read_ahead(lambda at: read(pages[at]), len(pages)):
            yield pages[index], future

    def _shard(self, records: list[PageRecord]) -> ShardRecord:
        return ShardRecord(model=self.task.bundle, pages=tuple(records), seconds=0.0)


@dataclass(frozen=True)
class _Page:
    """A page as `DecodedWriter` takes it."""

    symbols: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    model_version: str
    page: int | None


def lost_page(page: int, error: LightpageError) -> PageRecord:
    """The page that an error is about."""
    due, loss = False, type(error).__name__
    if isinstance(error, LostPageError):
        due, loss = error.recalibration_due, error.reason.value
    return PageRecord(page=page, state=PageState.LOST, loss=loss, reason=str(error), recalibration_due=due)


@contextmanager
def _recording_of(task: Task) -> Iterator[Recording]:
    """The recording of a task, or its recordings as one.

    Raises:
        RecordingError: see `Recording.open` and `join`.
    """
    if not task.more:
        with Recording.open(task.recording) as recording:
            yield recording
        return
    joined = task.shard.with_name(f".{task.shard.name}-joined.h5")  # swept where the worker is killed
    try:
        join([file.path for file in task.files], joined)
        with Recording.open(joined) as recording:
            yield recording
    finally:
        joined.unlink(missing_ok=True)


def _check_stamp(task: Task) -> None:
    """Check that recordings are those that the run began with.

    Raises:
        RecordingError: one has gone or has changed.
    """
    for file in task.files:
        subject = f"recording {file.path}"
        try:
            found = Stamp.of(file.path)
        except OSError as error:
            raise os_failure(subject, error, "the file that the run began with", RecordingError) from None
        if found != file.stamp:
            expected = f"{file.stamp.size} bytes, changed when the run began: begin another run with the new file"
            raise Changed(subject, f"{found.size} bytes, changed since", expected)


def _read_record(page: int, found: DecodedPage, measures: PageMeasures | None) -> PageRecord:
    known: dict[str, float | int | None] = {} if measures is None else dict(vars(measures))
    return PageRecord(
        page=page,
        state=PageState.READ,
        recalibration_due=found.check.recalibration_due,
        confirmed_bits=found.check.confirmed_bits,
        figures={
            "mean_confidence": float(found.confidence.mean()),
            "pilot_trust": found.pilot_trust,
            "claimed_bits": found.check.claimed_bits,
            **known,
        },
    )


def _recovered_record(page: RecoveredPage) -> PageRecord:
    return PageRecord(
        page=page.page,
        state=PageState.READ if page.loss is None else PageState.LOST,
        loss=page.loss,
        reason=page.reason,
        figures={
            "number": page.number,
            "volume": page.volume,
            "margin_bits": page.margin_bits,
            "corrected": page.corrected,
            "failed_blocks": page.failed_blocks,
            "air_bits_per_symbol": page.air_bits,
        },
    )


def _measured(page: DecodedPage, symbols: NDArray[np.uint8], data: NDArray[np.bool_]) -> PageMeasures | None:
    if not data.any():
        return None
    return measure(page.phase[data], page.concentration[data], symbols[data], page.levels)


def _summary(outcome: RecalibrationOutcome) -> dict[str, float | str | None]:
    """What became of a device, for people and programs."""
    return {
        "version": outcome.version,
        "previous_version": outcome.previous_version,
        "angle_deg": outcome.report.angle_deg,
        "air_before": outcome.air_before,
        "air_after": outcome.air_after,
        "air_limit": outcome.air_limit,
        "pages_used": outcome.pages_used,
        "pages_held_back": outcome.pages_held_back,
    }
