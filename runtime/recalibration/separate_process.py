"""Recalibration in a process of its own, at a low priority: reads go on as if nobody recalibrated."""

from __future__ import annotations

import glob
import logging
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from lightpage.errors import BundleError, SurroundingsError, WorkerError
from lightpage.failures import short_resource
from lightpage.helper_process import same_packages
from lightpage.progress import Progress
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import Tracker
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.outcome import RecalibrationOutcome
from lightpage.runtime.recalibration.work import Job, WorkFolder, heard_step
from lightpage.temporary import temporary_folder

_log = logging.getLogger(__name__)

WORKER = ("-P", "-m", "lightpage.runtime.recalibration.worker")

SCRATCH = ".recalibration-"
"""How the name of a folder begins in which a recalibration keeps its files."""

THREADS = 1
"""Of the worker's inferences and matrices: the other cores are left to reads."""

_POLL_S = 0.2
"""How often a silent worker's time and caller are looked at."""

_END_S = 5.0
"""Time that a worker gets to end once it has been told to."""

_SHOWN_BYTES = 2000
"""Of what a worker that broke has printed, for the log."""

_SUBJECT = "recalibration's process"


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
    worker: Sequence[str] = WORKER,
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
        worker: arguments of the interpreter that start the worker, before its folder.
        clock: seconds that never go back, by which `limit_s` is taken.

    Raises:
        WorkerError: the process was killed, broke, or took longer than `limit_s`.
        LightpageError: as `recalibrate` raises.
    """
    out = out.absolute()
    if out.exists() or out.is_symlink():
        raise BundleError(f"bundle {out}", "something that exists", "a new path: bundles are never overwritten")
    with _private_folder(scratch) as path:
        folder = WorkFolder(path)
        job = Job(bundle=decoder.bundle.path, out=out, version=version, threads=THREADS, memory=tracker.memory())
        try:
            folder.write_task(decoder.bundle, pages, job)
        except OSError as error:
            raise WorkerError(f"{_SUBJECT}, its folder", error, "room for the bundle and its pages") from error
        done = False
        try:
            with (path / "log").open("w+b") as log:
                status = _run([sys.executable, *worker, str(path)], log, progress, check, limit_s, clock)
                outcome = folder.read_result()
                if outcome is None:
                    _show(log)
                    raise WorkerError(_SUBJECT, f"its end with status {status}", "an outcome; try again")
            done = True
            return outcome
        finally:
            if not done:
                _remove_new(out)


@contextmanager
def _private_folder(scratch: Path | None) -> Iterator[Path]:
    try:
        folder = temporary_folder(f"{_SUBJECT}, its folder", SCRATCH, scratch)
    except SurroundingsError as error:
        raise WorkerError(error.subject, error.got, error.expected) from error
    with folder as name:
        yield Path(name)


def _run(
    command: Sequence[str],
    log: IO[bytes],
    progress: Progress,
    check: Callable[[], None],
    limit_s: float,
    clock: Callable[[], float],
) -> int:
    """Run the worker to its end, hand its steps on, and return its exit status; on an error it is ended."""
    until = clock() + limit_s
    lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    try:
        # Its input is a pipe that nobody writes to: once it is closed, the worker ends.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=same_packages(THREADS)
        )
    except OSError as error:
        short = short_resource(_SUBJECT, error)
        raise WorkerError(_SUBJECT, error, "one that can be started" if short is None else short.expected) from error
    try:
        assert process.stdout is not None  # asked for
        threading.Thread(target=_listen, args=(process.stdout, lines), name="lightpage-worker", daemon=True).start()
        while True:
            check()
            if (left := until - clock()) <= 0:
                raise WorkerError(_SUBJECT, f"no end within {limit_s:g} s", "one; nothing was changed")
            try:
                line = lines.get(timeout=min(_POLL_S, left))
            except queue.Empty:
                continue
            if line is None:
                return process.wait(_END_S)
            if (step := heard_step(line)) is not None:
                progress(*step)
    except subprocess.TimeoutExpired as error:
        raise WorkerError(_SUBJECT, "no end after its last word", "one; nothing was changed") from error
    finally:
        _end(process)


def _listen(stream: IO[bytes], lines: queue.SimpleQueue[bytes | None]) -> None:
    """Put each line that a worker prints into a queue, and None behind the last one."""
    with suppress(ValueError, OSError):  # the stream is closed under it where the worker is ended
        for line in stream:
            lines.put(line)
    lines.put(None)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a worker, however it takes that, and wait for it."""
    assert process.stdin is not None  # asked for
    with suppress(OSError):
        process.stdin.close()
    if process.poll() is None:
        process.kill()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


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
