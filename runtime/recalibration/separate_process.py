"""Recalibration in a process of its own, at a low priority: reads go on as if nobody recalibrated."""

import glob
import logging
import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO

from lightpage.errors import BundleError, WorkerError
from lightpage.helper_process import HelperProcess, same_packages
from lightpage.progress import Progress
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.recalibration.healing import LostPages
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome

_log = logging.getLogger(__name__)

WORKER = "lightpage.runtime.recalibration.worker:RecalibrationWorker"

THREADS = 1
"""Of the worker's inferences and matrices: the other cores are left to reads."""

_POLL_S = 0.2
"""How often a silent worker's time and caller are looked at."""

_SHOWN_BYTES = 2000
"""Of what a worker that broke has printed, for the log."""

_SUBJECT = "recalibration"


def recalibrate_apart(
    decoder: Decoder,
    tracker: Tracker,
    pages: KnownPages | LostPages,
    out: Path,
    version: str,
    progress: Progress,
    check: Callable[[], None],
    limit_s: float,
    worker: str = WORKER,
    clock: Callable[[], float] = time.monotonic,
) -> RecalibrationOutcome:
    """Recalibrate in a process of its own; see `recalibrate`, and `recalibrate_by_lost` for lost pages.

    Whatever ends it early, the process and what it has written of the new bundle are gone.

    Args:
        decoder: the model in service.
        tracker: tracker of the service; the worker goes on from what it has learnt.
        pages: pages with known symbols, or pages that the model does not read.
        out: a new path.
        version: version of the new bundle.
        progress: told of every step.
        check: called several times a second; what it raises ends the work.
        limit_s: longest time that it may take, seconds.
        worker: what the process makes, a `RecalibrationWorker`.
        clock: seconds that never go back, by which `limit_s` is taken.

    Raises:
        WorkerError: the process was killed, broke, or took longer than `limit_s`.
        LightpageError: as `recalibrate` raises.
    """
    out = out.absolute()
    if out.exists() or out.is_symlink():
        raise BundleError(f"bundle {out}", "something that exists", "a new path: bundles are never overwritten")
    with os.fdopen(os.memfd_create("recalibration-log"), "w+b") as log:
        try:
            process = HelperProcess(worker, subject=_SUBJECT, environment=same_packages(THREADS), log=log)
            try:
                until = clock() + limit_s
                # The bundle goes as it lies in memory, without what was computed of it: its file may have changed.
                task = replace(decoder.bundle), pages, out, version, tracker.memory()
                process.send("recalibrate", *task, decoder.steps, progress=progress)
                while not process.poll(_POLL_S):
                    check()
                    if clock() >= until:
                        raise WorkerError(_SUBJECT, f"no end within {limit_s:g} s", "one; nothing was changed")
                outcome: RecalibrationOutcome = process.answer()
                return outcome
            finally:
                process.end()
        except BaseException as error:
            if isinstance(error, WorkerError):
                _show(log)
            _remove_new(out)
            raise


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
