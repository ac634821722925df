"""Runs one recalibration at a time beside the decoding, as a job, and puts the result in service."""

import logging
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import count as counting
from pathlib import Path

from lightpage.errors import (
    BundleError,
    CallerLeft,
    InvalidInputError,
    JobCancelledError,
    LimitError,
    NoSourceError,
    OtherModelError,
    RecalibrationRefusedError,
    RecordingError,
    SourceError,
    StoppingError,
    let_go,
)
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import check_recording
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.acquisition.source import FrameSource, own_fault
from lightpage.runtime.model.bundle.archive import check_name
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.recalibration.healed_bundle import recalibrate_by_lost
from lightpage.runtime.recalibration.healing import LostPages
from lightpage.runtime.recalibration.known_pages import KnownPages, read_recorded
from lightpage.runtime.recalibration.recalibration import (
    RecalibrationOutcome,
    Refit,
    next_version,
    reading_share,
    recalibrate,
)
from lightpage.runtime.recalibration.separate_process import recalibrate_apart
from lightpage.runtime.service.caller import NOBODY, Actor, Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.jobs import Jobs, RunningJob
from lightpage.runtime.service.jobs.kept_pages import KeptPages
from lightpage.runtime.service.limits import GRACE_S
from lightpage.runtime.service.models.loader import Model

_log = logging.getLogger(__name__)

_POLL_S = 0.25
"""How often a silent recalibration looks whether its caller is still there."""


@dataclass(frozen=True)
class Step:
    """Progress: what is being done, and how far all of it is, 0..1."""

    name: str
    fraction: float


_Told = Step | RecalibrationOutcome | BaseException


def _nothing() -> None:
    """Nobody listens."""


@dataclass(frozen=True)
class PagesToUse:
    """Pages to recalibrate with, not read yet.

    Attributes:
        of: where they come from, for people.
        read: reads them on behalf of a caller, and calls what it is given before each.
        count: how many are to be read, 0 where that is not known, or they are here already.
        own: whether they are the service's own: then it is not the caller's fault if they are dark or damaged.
        release: called once they are not needed any more, also where the job does not begin.
    """

    of: str
    read: Callable[[Callable[[], None], Caller], KnownPages | LostPages]
    count: int = 0
    own: bool = True
    release: Callable[[], None] = _nothing


class Recalibrator:
    """Recalibrates the model in service, each time as a job of which one runs at a time.

    A job is followed by whoever iterates over its steps, and ends with the iterator; or it is started, and goes on by
    itself. Iterators begin with their first step.

    Args:
        plane: data plane with model, source, store and limits.
        fit: how to fit, in this process; None for the real re-fit in a process of its own, at a low priority.
        recordings: folder whose recordings a caller may name, or None for none.

    Attributes:
        jobs: jobs that run or have ended.
    """

    def __init__(self, plane: DataPlane, fit: Refit | None = None, recordings: Path | None = None) -> None:
        self._plane, self._fit, self._recordings = plane, fit, recordings
        self.jobs = Jobs(plane.models.store, plane.limits.jobs_kept)
        self._stop = threading.Event()

    def source_pages(self, count: int, pages: Sequence[int] = ()) -> PagesToUse:
        """`pages` of the source, or its next `count`.

        Raises:
            LimitError: more pages than the service takes.
            SourceError: there is no source.
        """
        source, slots = self._plane.source, self._plane.decodes
        self.check_count(len(pages) or count)
        expected: list[int | None] = list(pages) or [None] * count

        def read(heard: Callable[[], None], caller: Caller) -> KnownPages:
            return read_known(source, expected, heard, lambda: slots.held(caller))

        return PagesToUse("source", read, len(expected))

    def recorded_pages(self, name: str, count: int) -> PagesToUse:
        """The first `count` pages (0: all) of a recording in the recordings folder.

        Raises:
            LimitError: more pages than the service takes.
            SourceError: there is no recordings folder.
            InvalidInputError: no such file in it.
        """
        path = self._path(name)
        self.check_count(count)

        def read(heard: Callable[[], None], caller: Caller) -> KnownPages:
            with own_fault():
                opened = Recording.open(path)
            with opened as recording:
                check_recording(self._plane.models.current.decoder, recording)
                if recording.pages < count:
                    raise RecordingError(f"recording {name}", f"{recording.pages} pages", f"at least {count}")
                self.check_count(count or recording.pages)
                with own_fault():
                    return read_recorded(recording, range(count or recording.pages), heard)

        return PagesToUse(f"recording {name}", read, count)

    def kept_pages(self, kept: KeptPages) -> PagesToUse | None:
        """The last pages of the device, those that were read or else those that were lost; None if none are kept."""
        model = self._plane.models.current
        pages = kept.pages(model.decoder, model.tracker.image_px)
        if pages is None:
            return None
        what = "lost pages" if isinstance(pages, LostPages) else "pages that were read"
        return PagesToUse(what, lambda heard, caller: pages)

    def sent_pages(self, pages: KnownPages, release: Callable[[], None] = _nothing) -> PagesToUse:
        """Pages whose frames a caller has sent, checked.

        Args:
            pages: all of them; those without light are left out.
            release: see `PagesToUse`.

        Raises:
            InvalidInputError: too few pages, or the same one twice.
            FrameError: a bad frame, or too few pages with light.
            PageError: symbols of the wrong shape or range.
        """
        decoder = self._plane.models.current.decoder
        lit = pages.lit(decoder.bundle.manifest.camera_bit_depth)
        lit.check(decoder)
        return PagesToUse("frames", lambda heard, caller: lit, own=False, release=release)

    def from_source(self, count: int, pages: Sequence[int], caller: Caller) -> Iterator[Step | RecalibrationOutcome]:
        """Recalibrate with `pages` of the source, or with its next `count`; see `follow`."""
        return self.follow(self.source_pages(count, pages), caller)

    def follow(
        self, pages: PagesToUse, caller: Caller, expected_version: str = "", correlation_id: str = ""
    ) -> Iterator[Step | RecalibrationOutcome]:
        """Begin a job and follow it: yields its steps, then its outcome. One who stops iterating stops the job.

        Raises:
            BusyError: another recalibration runs.
            OtherModelError: another model than `expected_version` is in service; empty stands for any.
            RecalibrationRefusedError: the new model would not be better; the old one stays.
            SourceError: a source that is damaged, or does not know what was written; a damaged or dark recording.
            RecordingError: another device's recording, or too short a one.
            PageError: no such page, or a recording without symbols.
            InvalidInputError: too few pages, or the same one twice.
            JobCancelledError: somebody has cancelled the job.
        """
        steps: queue.SimpleQueue[_Told] = queue.SimpleQueue()
        own = Caller(caller.seconds_left, actor=caller.actor)
        running = self._begin(pages, own, steps.put, expected_version, correlation_id)
        try:
            yield from _follow(steps, caller)
        finally:
            running.caller.leave()

    def start(
        self, pages: PagesToUse, expected_version: str = "", correlation_id: str = "", actor: Actor = NOBODY
    ) -> pb.Job:
        """Start a job that goes on by itself; returns it as it begins.

        Raises:
            BusyError: another one runs.
            OtherModelError: another model is in service than `expected_version`; empty stands for any.
            StoppingError: the service is being stopped.
        """
        running = self._begin(pages, Caller(actor=actor), lambda _: None, expected_version, correlation_id)
        return self.jobs.job(running.id)

    def check_start(self, expected_version: str = "") -> None:
        """See whether a job may begin now; raises as `start` would, and `StoreError` without a folder for it."""
        self._check_serving()
        self.jobs.check_free()
        _check_version(self._plane.models.current, expected_version)
        _ = self._plane.models.store.folder.path  # it is there

    def close(self, wait_s: float = GRACE_S) -> None:
        """Stop a running recalibration at its next step, which is waited for at most `wait_s`.

        One that takes longer changes nothing any more.
        """
        self._stop.set()
        if not self.jobs.wait_idle(wait_s):
            _log.warning("recalibration: not stopped after %.1f s, left to itself", wait_s)

    def _check_serving(self) -> None:
        if self._stop.is_set():
            raise StoppingError("recalibration", "a service that stops", "one that serves; nothing was changed")

    def _begin(
        self,
        pages: PagesToUse,
        caller: Caller,
        tell: Callable[[_Told], None],
        expected_version: str,
        correlation_id: str,
    ) -> RunningJob:
        """Begin a job in a thread of its own; `tell` is told of its steps, and of its outcome or error."""
        try:
            self.check_start(expected_version)
            running = self.jobs.begin(pages.of, caller, correlation_id)
            try:
                work = partial(self._run, running, pages, expected_version, tell)
                threading.Thread(target=work, name="lightpage-recalibration", daemon=True).start()
            except BaseException as error:
                self.jobs.end(running, error)
                raise
        except BaseException:
            pages.release()
            raise
        return running

    def _run(
        self, running: RunningJob, pages: PagesToUse, expected_version: str, tell: Callable[[_Told], None]
    ) -> None:
        def check() -> None:
            self._check_serving()
            running.check()

        def progress(name: str, fraction: float) -> None:
            check()
            self.jobs.tell(running, name, fraction)
            tell(Step(name, fraction))

        share, read = reading_share(pages.count), counting()

        def heard() -> None:
            progress("read the pages", share * min(1.0, next(read) / (pages.count + 1)))

        def working(name: str, fraction: float) -> None:
            progress(name, share + (1 - share) * fraction)

        end: RecalibrationOutcome | BaseException
        try:
            heard()
            self._plane.models.store.check()
            end = self._work(running, pages, pages.read(heard, running.caller), working, check, expected_version)
        except CallerLeft as left:  # whoever waits for a slot knows no more than that
            end = _cause(check, left)
        except BaseException as error:
            end = error
        finally:
            pages.release()
        self._count(end)
        # Before the last step is told: whoever hears the end may start the next one at once.
        self.jobs.end(running, end)
        if isinstance(end, BaseException):
            let_go(end)  # of the pages
        tell(end)
        del end  # it holds this frame, which holds it

    def _work(
        self,
        running: RunningJob,
        task: PagesToUse,
        pages: KnownPages | LostPages,
        progress: Progress,
        check: Callable[[], None],
        expected_version: str,
    ) -> RecalibrationOutcome:
        models = self._plane.models
        model, folder = models.current, models.store.folder
        _check_version(model, expected_version)  # it may have changed while pages were read
        if isinstance(pages, KnownPages):
            with own_fault() if task.own else nullcontext():
                pages = pages.lit(model.decoder.bundle.manifest.camera_bit_depth)
                pages.check(model.decoder)
        version = next_version(model.version, models.versions())
        path = folder.bundle(version)
        # Judged against what is in service now: the model with what its tracker has learnt.
        if self._fit is None:
            limit_s = self._plane.limits.recalibration_s
            outcome = recalibrate_apart(model.decoder, model.tracker, pages, path, version, progress, check, limit_s)
        elif isinstance(pages, LostPages):
            outcome = recalibrate_by_lost(model.decoder, pages, path, version, self._fit, progress, model.tracker)
        else:
            outcome = recalibrate(model.decoder, pages, path, version, self._fit, progress, model.tracker)
        try:
            progress("put the new model in service", 1.0)
            decoder = model.decoder.of_another(Bundle.open(path))
            models.adopt(decoder, model, running.caller.actor, self.jobs.done(running, outcome))
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        models.prune()
        return outcome

    def _count(self, result: RecalibrationOutcome | BaseException) -> None:
        if isinstance(result, RecalibrationOutcome):
            name = "done"
        elif isinstance(result, RecalibrationRefusedError):
            name = "refused"
        else:
            dropped = isinstance(result, CallerLeft | JobCancelledError | StoppingError)
            name = "dropped" if dropped else "failed"
        self._plane.metrics.recalibrations.labels(name).inc()
        _log.info("recalibration %s", name)

    def check_count(self, count: int) -> None:
        """Check a number of pages.

        Raises:
            LimitError: more than the service takes.
        """
        if count > (limit := self._plane.limits.recalibration_pages):
            raise LimitError("pages to recalibrate with", count, f"at most {limit}")

    def _path(self, name: str) -> Path:
        subject = "recording to recalibrate with"
        if self._recordings is None:
            raise NoSourceError(subject, name, "a service started with --recordings")
        try:
            check_name(name, subject)
        except BundleError as error:
            raise InvalidInputError(subject, repr(name), "a plain file name without folders") from error
        path = self._recordings / name
        try:
            is_there = not path.is_symlink() and path.is_file()
        except OSError:  # a name longer than the file system takes
            is_there = False
        if not is_there:
            raise InvalidInputError(subject, repr(name), "a file in the recordings folder")
        return path


def _check_version(model: Model, expected: str) -> None:
    if expected and model.version != expected:
        raise OtherModelError("model in service", model.version, f"{expected}, as the caller expects")


def _cause(check: Callable[[], None], left: CallerLeft) -> BaseException:
    """Why a job's caller has left: what `check` raises."""
    try:
        check()
    except Exception as cause:
        return cause
    return left


def read_known(
    source: FrameSource,
    pages: Sequence[int | None],
    heard: Callable[[], None],
    slot: Callable[[], AbstractContextManager[None]],
) -> KnownPages:
    """Pages of a source with their symbols.

    Args:
        source: where they come from.
        pages: their numbers, None for the next one.
        heard: called before each page; it may raise to stop.
        slot: held while one page is photographed, or the references: whoever reads waits for one of them at most.

    Raises:
        PageError: no such page.
        SlotsTakenError: no slot in time.
        SourceError: the source is damaged, or does not know what was written.
    """
    found = []
    with own_fault():
        for page in pages:
            heard()
            with slot():
                found.append(source.shot(source.shot_s, page))
        heard()
        with slot():
            references = source.references()
    symbols = [read.symbols for read in found if read.symbols is not None]
    if len(symbols) != len(found):
        raise SourceError(f"pages of {source.name}", "unknown symbols", "pages whose symbols are known")
    mask = found[0].pilot_mask if found else None
    return KnownPages(tuple(p.pair for p in found), tuple(symbols), source.levels, references, mask)


def _follow(steps: queue.SimpleQueue[_Told], caller: Caller) -> Iterator[Step | RecalibrationOutcome]:
    """Hand on what the worker tells, until its outcome or error, or until the caller has gone."""
    while True:
        try:
            step = steps.get(timeout=_POLL_S)
        except queue.Empty:
            caller.check()
            continue
        if isinstance(step, BaseException):
            try:
                raise step
            finally:
                del step  # it holds this frame, which holds it
        yield step
        if isinstance(step, RecalibrationOutcome):
            return
        caller.check()
