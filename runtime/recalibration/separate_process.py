"""Recalibration in a process of its own, at a low priority: reads go on as if nobody recalibrated.

What goes into it, and what comes out, are files of one private folder.
"""

from __future__ import annotations

import glob
import json
import logging
import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter

from lightpage.errors import ERRORS, BundleError, LightpageError, SurroundingsError, WorkerError, raised_as
from lightpage.failures import short_resource
from lightpage.helper_process import HelperProcess, same_packages
from lightpage.progress import Progress
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle, write_bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import Tracker, TrackerMemory
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome
from lightpage.temporary import temporary_folder

_log = logging.getLogger(__name__)

WORKER = "lightpage.runtime.recalibration.worker"

SCRATCH = ".recalibration-"
"""How the name of a folder begins in which a recalibration keeps its files."""

THREADS = 1
"""Of the worker's inferences and matrices: the other cores are left to reads."""

_POLL_S = 0.2
"""How often a silent worker's time and caller are looked at."""

_END_S = 5.0
"""Time that a worker gets to end after its last word."""

_SHOWN_BYTES = 2000
"""Of what a worker that broke has printed, for the log."""

_SUBJECT = "recalibration's process"

_BUNDLE, _PAGES, _JOB, _RESULT = "bundle.zip", "pages.npz", "job.json", "result.json"

_OUTCOME = TypeAdapter(RecalibrationOutcome)


class Job(BaseModel):
    """What a recalibration shall do, beside its bundle and its pages.

    Attributes:
        bundle: where the bundle came from, for messages.
        out: path of the new bundle.
        version: of the new bundle.
        memory: of the service's tracker; None where it follows nothing.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    bundle: Path
    out: Path
    version: str
    memory: TrackerMemory | None


@dataclass(frozen=True)
class WorkFolder:
    """A private folder that one recalibration is handed over in.

    Attributes:
        path: that exists, and belongs to nobody else.
    """

    path: Path

    def write_task(self, bundle: Bundle, pages: KnownPages, job: Job) -> None:
        """Write all that the worker needs. The bundle is written as it lies in memory: its file may have changed.

        Raises:
            BundleError, OSError: the folder cannot be written.
        """
        write_bundle(self.path / _BUNDLE, bundle.manifest, bundle.files)
        arrays: dict[str, Any] = {
            "in_phase": np.stack([pair.in_phase for pair in pages.pairs]),
            "quadrature": np.stack([pair.quadrature for pair in pages.pairs]),
            "symbols": np.stack(pages.symbols),
            "levels": pages.levels,
            "image_px": pages.image_px,
        }
        if pages.references is not None:
            arrays["reference_in_phase"] = pages.references.in_phase
            arrays["reference_quadrature"] = pages.references.quadrature
        if pages.pilot_mask is not None:
            arrays["pilot_mask"] = pages.pilot_mask
        np.savez(self.path / _PAGES, **arrays)
        (self.path / _JOB).write_text(job.model_dump_json())

    def read_task(self) -> tuple[Bundle, KnownPages, Job]:
        """What the worker needs.

        Raises:
            BundleError, OSError, ValueError: the folder is none that `write_task` has filled.
        """
        job = Job.model_validate_json((self.path / _JOB).read_bytes())
        bundle = replace(Bundle.open(self.path / _BUNDLE), path=job.bundle)
        with np.load(self.path / _PAGES, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        frames = zip(arrays["in_phase"], arrays["quadrature"], strict=True)
        references = None
        if "reference_in_phase" in arrays:
            references = FramePair(arrays["reference_in_phase"], arrays["reference_quadrature"])
        x, y = map(float, arrays["image_px"])
        pairs, symbols, levels = tuple(FramePair(*pair) for pair in frames), tuple(arrays["symbols"]), arrays["levels"]
        return bundle, KnownPages(pairs, symbols, int(levels), references, arrays.get("pilot_mask"), (x, y)), job

    def write_result(self, result: RecalibrationOutcome | LightpageError) -> None:
        """Write what the recalibration found, or why there is no outcome."""
        if isinstance(result, LightpageError):
            words = {name: vars(result)[name] for name in ("subject", "got", "expected")}
            told = {"error": {"kind": type(result).__name__, **words}}
        else:
            told = {"outcome": _OUTCOME.dump_python(result, mode="json")}
        made = self.path / f"{_RESULT}.made"
        made.write_text(json.dumps(told))
        made.rename(self.path / _RESULT)

    def read_result(self) -> RecalibrationOutcome | None:
        """What the recalibration found; None where it came to no end.

        Raises:
            LightpageError: of the class and with the words that the worker met.
        """
        try:
            result = json.loads((self.path / _RESULT).read_bytes())
        except FileNotFoundError:
            return None
        if (told := result.get("error")) is not None:
            raise ERRORS[told["kind"]](told["subject"], told["got"], told["expected"])
        return _OUTCOME.validate_python(result["outcome"])


def recalibrate_apart(
    decoder: Decoder,
    tracker: Tracker,
    pages: KnownPages,
    out: Path,
    version: str,
    progress: Progress,
    check: Callable[[], None],
    limit_s: float,
    scratch: Path | None = None,
    worker: str = WORKER,
    clock: Callable[[], float] = time.monotonic,
) -> RecalibrationOutcome:
    """Recalibrate in a process of its own; see `lightpage.runtime.recalibration.recalibration.recalibrate`.

    Whatever ends it early, the process, its files and what it has written of the new bundle are gone.

    Args:
        decoder: the model in service.
        tracker: of the service; the worker goes on from what it has learnt.
        pages: pages with known symbols.
        out: a new path.
        version: of the new bundle.
        progress: told of every step.
        check: called several times a second; what it raises ends the work.
        limit_s: longest time that it may take, seconds.
        scratch: folder for the work's own files, in a hidden folder of it whose name begins with `SCRATCH`; the
            machine's temporary folder if None.
        worker: module that the process runs, with its folder as the argument.
        clock: seconds that never go back, by which `limit_s` is taken.

    Raises:
        WorkerError: the process was killed, broke, or took longer than `limit_s`.
        LightpageError: as `recalibrate` raises.
    """
    out = out.absolute()
    if out.exists() or out.is_symlink():
        raise BundleError(f"bundle {out}", "something that exists", "a new path: bundles are never overwritten")
    with raised_as(WorkerError, SurroundingsError):
        private = temporary_folder(f"{_SUBJECT}, its folder", SCRATCH, scratch)
    with private as name:
        folder = WorkFolder(Path(name))
        job = Job(bundle=decoder.bundle.path, out=out, version=version, memory=tracker.memory())
        try:
            folder.write_task(decoder.bundle, pages, job)
        except OSError as error:
            raise WorkerError(f"{_SUBJECT}, its folder", error, "room for the bundle and its pages") from error
        try:
            with (folder.path / "log").open("w+b") as log:
                status = _run(worker, folder.path, log, progress, check, limit_s, clock)
                if (outcome := folder.read_result()) is None:
                    _show(log)
                    raise WorkerError(_SUBJECT, f"its end with status {status}", "an outcome; try again")
            return outcome
        except BaseException:
            _remove_new(out)
            raise


def _run(
    worker: str,
    folder: Path,
    log: IO[bytes],
    progress: Progress,
    check: Callable[[], None],
    limit_s: float,
    clock: Callable[[], float],
) -> int | None:
    """Run the worker to its end, hand its steps on, and return its exit status; on an error it is ended."""
    until = clock() + limit_s
    try:
        process = HelperProcess(worker, str(folder), subject=_SUBJECT, environment=same_packages(THREADS), log=log)
    except OSError as error:
        short = short_resource(_SUBJECT, error)
        raise WorkerError(_SUBJECT, error, "one that can be started" if short is None else short.expected) from error
    grace_s = 0.0
    try:
        while True:
            check()
            if (left := until - clock()) <= 0:
                raise WorkerError(_SUBJECT, f"no end within {limit_s:g} s", "one; nothing was changed")
            try:
                line = process.line(time.monotonic() + min(_POLL_S, left))
            except TimeoutError:
                continue
            except ConnectionError:
                grace_s = _END_S
                break
            progress(*json.loads(line))
    finally:
        process.end(grace_s)
    return process.status


def _show(log: IO[bytes]) -> None:
    """Log the end of what a worker that broke has printed."""
    log.seek(max(0, log.seek(0, os.SEEK_END) - _SHOWN_BYTES))
    if text := log.read().decode("utf-8", "replace").strip():
        _log.warning("%s printed: %s", _SUBJECT, text)


def _remove_new(out: Path) -> None:
    """Remove what a worker that was cut off has written of the new bundle."""
    with suppress(OSError):
        out.unlink(missing_ok=True)
        for unfinished in out.parent.glob(f".{glob.escape(out.name)}-*"):
            shutil.rmtree(unfinished, ignore_errors=True)
