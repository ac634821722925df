"""Runs one recalibration at a time beside the decoding, reports its progress, and puts the result in service."""

from __future__ import annotations

import logging
import queue
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lightpage.errors import (
    BusyError,
    InvalidInputError,
    LimitError,
    PageError,
    RecalibrationRefusedError,
    RecordingError,
)
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from runtime.acquisition.source import FrameSource, own_fault
from runtime.bulk.evaluation import check_recording
from runtime.bundle.archive import check_name
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from runtime.decoding.frames import narrow
from runtime.errors import CallerLeft, SourceError, StoppingError
from runtime.recalibration.known_pages import KnownPages
from runtime.recalibration.outcome import RecalibrationOutcome, Refit
from runtime.recalibration.recalibration import next_version, recalibrate
from runtime.recalibration.separate_process import recalibrate_apart
from runtime.service.caller import Actor, Caller
from runtime.service.dataplane import DataPlane
from runtime.service.limits import GRACE_S
from runtime.service.store import ModelStore

_log = logging.getLogger(__name__)

_POLL_S = 0.25
"""How often a silent recalibration looks whether its caller is still there."""


@dataclass(frozen=True)
class Step:
    """Progress: what is being done, and how far all of it is, 0..1."""

    name: str
    fraction: float


class Recalibrator:
    """Recalibrates the model in service. Its iterators begin with their first step, and end the work when closed.

    Args:
        plane: whose model, source and limits.
        fit: how to fit, in this process; None for the real re-fit in a process of its own, at a low priority.
        recordings: folder whose recordings a caller may name, or None for none.
    """

    def __init__(self, plane: DataPlane, fit: Refit | None = None, recordings: Path | None = None) -> None:
        self._plane, self._fit, self._recordings = plane, fit, recordings
        self._busy = threading.Lock()
        """Held from the first page read to the swap; a second recalibration finds it taken and is turned away."""
        self._stop = threading.Event()
        self._temporary: tempfile.TemporaryDirectory[str] | None = None

    def from_source(self, count: int, pages: Sequence[int], caller: Caller) -> Iterator[Step | RecalibrationOutcome]:
        """Recalibrate with `pages` of the source, or with its next `count`; yields steps, then the outcome.

        Raises:
            BusyError: another recalibration runs.
            LimitError: more pages than the service takes.
            RecalibrationRefusedError: the new model would not be better; the old one stays.
            SourceError: no source, a damaged one, or one that does not know what was written.
            InvalidInputError: no such pages, too few, or the same one twice.
        """
        source, slots = self._plane.source, self._plane.decodes
        self._check_count(len(pages) or count)
        expected: list[int | None] = list(pages) or [None] * count
        return self._run(lambda heard: read_known(source, expected, heard, lambda: slots.held(caller)), caller)

    def from_recording(self, name: str, count: int, caller: Caller) -> Iterator[Step | RecalibrationOutcome]:
        """Recalibrate with the first `count` pages (0: all) of a recording in the recordings folder.

        Yields and raises as `from_source`, and `RecordingError` for another device's recording or too short a one,
        `PageError` for one without symbols; one that is damaged or dark is the service's fault, as a source is.
        """
        path = self._path(name)
        self._check_count(count)

        def read(heard: Callable[[], None]) -> KnownPages:
            with own_fault():
                opened = Recording.open(path)
            with opened as recording:
                check_recording(self._plane.registry.current.decoder, recording)
                if recording.pages < count:
                    raise RecordingError(f"recording {name}", f"{recording.pages} pages", f"at least {count}")
                self._check_count(count or recording.pages)
                with own_fault():
                    return read_recorded(recording, range(count or recording.pages), heard)

        return self._run(read, caller)

    def close(self, wait_s: float = GRACE_S) -> None:
        """Stop a running recalibration at its next step, which is waited for at most `wait_s`; drop temporary bundles.

        One that takes longer changes nothing any more; its temporary bundles are dropped when the process ends.
        """
        self._stop.set()
        if not self._busy.acquire(timeout=wait_s):
            _log.warning("recalibration: not stopped after %.1f s, left to itself", wait_s)
            return
        try:
            if self._temporary is not None:
                self._temporary.cleanup()
                self._temporary = None
        finally:
            self._busy.release()

    def _run(
        self, read: Callable[[Callable[[], None]], KnownPages], caller: Caller
    ) -> Iterator[Step | RecalibrationOutcome]:
        """Work in a thread of its own; one who stops iterating stops it at its next step.

        `read` reads the pages, and calls what it is given before each.
        """
        if not self._busy.acquire(blocking=False):
            raise BusyError("recalibration", "one that is running", "one at a time; try again when it has ended")
        steps: queue.SimpleQueue[Step | RecalibrationOutcome | BaseException] = queue.SimpleQueue()
        left = threading.Event()

        def check() -> None:
            if self._stop.is_set():
                raise StoppingError("recalibration", "a service that stops", "one that serves; nothing was changed")
            if left.is_set():
                raise CallerLeft

        def progress(name: str, fraction: float) -> None:
            check()
            steps.put(Step(name, fraction))

        def work() -> None:
            try:
                heard = partial(progress, "read the pages", 0.0)
                heard()
                result: RecalibrationOutcome | BaseException = self._work(read(heard), progress, check, caller.actor)
            except BaseException as error:
                result = error
            finally:
                # Before the last step is told: whoever hears the end may start the next one at once.
                self._busy.release()
            self._count(result)
            steps.put(result)

        thread = threading.Thread(target=work, name="lightpage-recalibration", daemon=True)
        try:
            thread.start()
        except BaseException:
            self._busy.release()
            raise
        try:
            yield from _follow(steps, caller)
        finally:
            left.set()

    def _work(
        self, pages: KnownPages, progress: Progress, check: Callable[[], None], actor: Actor
    ) -> RecalibrationOutcome:
        plane = self._plane
        model = plane.registry.current
        with own_fault():  # the pages are the service's own
            pages = pages.lit(model.decoder.bundle.manifest.camera_bit_depth)
            pages.check(model.decoder)
        store = self._store()
        version = next_version(model.version, [*(m.version for m in plane.registry.models), *store.versions()])
        path = store.path_of(version)
        # Judged against what is in service now: the model with what its tracker has learnt.
        if self._fit is None:
            limit_s = plane.limits.recalibration_s
            outcome = recalibrate_apart(model.decoder, model.tracker, pages, path, version, progress, check, limit_s)
        else:
            outcome = recalibrate(model.decoder, pages, path, version, self._fit, progress, model.tracker)
        try:
            progress("put the new model in service", 1.0)
            plane.adopt(Decoder(Bundle.open(path), model.decoder.threads), expected=model, actor=actor)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        self._prune(store)
        return outcome

    def _prune(self, store: ModelStore) -> None:
        try:
            dropped = store.prune([model.decoder.bundle.path for model in self._plane.registry.models])
        except OSError as error:  # the new model serves all the same
            _log.warning("model store %s: old bundles stay: %s", store.folder, error)
        else:
            for path in dropped:
                _log.info("model store %s: dropped %s", store.folder, path.name)

    def _store(self) -> ModelStore:
        """The service's store; without one, a temporary folder that keeps no more than the models held."""
        if self._plane.store is not None:
            return self._plane.store
        if self._temporary is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="lightpage-models-")
        return ModelStore(Path(self._temporary.name), self._plane.registry.current.decoder.bundle, kept=0)

    def _count(self, result: RecalibrationOutcome | BaseException) -> None:
        if isinstance(result, RecalibrationOutcome):
            name = "done"
        elif isinstance(result, RecalibrationRefusedError):
            name = "refused"
        else:
            name = "dropped" if isinstance(result, CallerLeft | StoppingError) else "failed"
        self._plane.metrics.recalibrations.labels(name).inc()
        _log.info("recalibration %s", name)

    def _check_count(self, count: int) -> None:
        if count > self._plane.limits.recalibration_pages:
            limit = self._plane.limits.recalibration_pages
            raise LimitError("pages to recalibrate with", count, f"at most {limit}")

    def _path(self, name: str) -> Path:
        if self._recordings is None:
            raise SourceError("recording to recalibrate with", name, "a service started with --recordings")
        try:
            check_name(name, "recording to recalibrate with")
        except Exception as error:
            raise InvalidInputError(
                "recording to recalibrate with", repr(name), "a plain file name without folders"
            ) from error
        path = self._recordings / name
        try:
            is_there = not path.is_symlink() and path.is_file()
        except OSError:  # a name longer than the file system takes
            is_there = False
        if not is_there:
            raise InvalidInputError("recording to recalibrate with", repr(name), "a file in the recordings folder")
        return path


def _nothing() -> None:
    """Nobody listens."""


def read_known(
    source: FrameSource,
    pages: Sequence[int | None],
    heard: Callable[[], None] = _nothing,
    slot: Callable[[], AbstractContextManager[None]] = nullcontext,
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


def read_recorded(recording: Recording, pages: Sequence[int], heard: Callable[[], None] = _nothing) -> KnownPages:
    """Pages of a recording with their symbols.

    Args:
        recording: where they are.
        pages: their numbers.
        heard: called before each page; it may raise to stop.

    Raises:
        RecordingError: unreadable.
        PageError: the recording holds no symbols.
    """
    symbols = [found for index in pages if (found := recording.symbols(index)) is not None]
    if len(symbols) != len(pages):
        raise PageError(f"recording {recording.path}", "no symbols", "a recording with known symbols")
    bits, pairs = recording.bit_depth, []
    for index in pages:
        heard()
        pairs.append(narrow(recording.frames(index), bits))
    references = narrow(recording.references(), bits)
    return KnownPages(tuple(pairs), tuple(symbols), recording.levels, references, recording.pilots())


def _follow(
    steps: queue.SimpleQueue[Step | RecalibrationOutcome | BaseException], caller: Caller
) -> Iterator[Step | RecalibrationOutcome]:
    """Hand on what the worker tells, until its outcome or error, or until the caller has gone."""
    while True:
        try:
            step = steps.get(timeout=_POLL_S)
        except queue.Empty:
            caller.check()
            continue
        if isinstance(step, BaseException):
            raise step
        yield step
        if isinstance(step, RecalibrationOutcome):
            return
        caller.check()
