"""A recalibration's own process, started by `separate_process` with the folder of its work."""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import LightpageError
from lightpage.helper_process import parent_link
from lightpage.progress import Progress
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.recalibration.recalibration import Refit, recalibrate
from lightpage.runtime.recalibration.refit import refit
from lightpage.runtime.recalibration.separate_process import THREADS, WorkFolder

NICENESS = 10
"""Beside reads without a pause such a process gets a tenth of a core, and ends. With a higher niceness it would starve,
as it would under SCHED_IDLE."""

LOWEST = 19
"""Its niceness once reads have been found to leave it room: it then does with what they leave."""

ROOM = 0.3
"""Share of a core that it has had lately, from which on they do."""

_LOOK_S = 1.0

_PARENT_GONE = 3


def work(folder: WorkFolder, progress: Progress, fit: Refit = refit) -> None:
    """Recalibrate as a folder says, and leave the outcome or the error in the folder.

    Args:
        folder: filled by the parent.
        progress: told of every step.
        fit: how to fit.
    """
    try:
        bundle, pages, job = folder.read_task()
        decoder = Decoder(bundle, THREADS)
        tracker = NoTracker(decoder) if job.memory is None else tracker_for(decoder, job.memory)
        folder.write_result(recalibrate(decoder, pages, job.out, job.version, fit, progress, tracker))
    except LightpageError as error:
        folder.write_result(error)


def yield_to_reads() -> None:
    """Take what processor time reads leave, as far as the system lets a process ask for that."""
    with suppress(OSError):
        os.nice(NICENESS)
    if hasattr(os, "SCHED_BATCH"):
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def yield_more(clock: Clock = SYSTEM, worked: Callable[[], float] = time.process_time) -> threading.Thread:
    """Yield all to reads, from a thread, as soon as they leave room.

    There is no way back: who has not the right to it cannot raise a priority. Where reads leave no pause later on, the
    work runs into its limit of time, and the next one begins as this one did.

    Args:
        clock: by which the time passes over which it is taken.
        worked: processor time that this process has had, seconds.
    """

    def watch() -> None:
        share = -1.0
        while share < ROOM:
            begun, before = clock.now(), worked()
            clock.sleep(_LOOK_S)
            share = (worked() - before) / (clock.now() - begun)
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, os.getpid(), LOWEST)  # of the thread that works, which is the first one

    thread = threading.Thread(target=watch, name="lightpage-priority", daemon=True)
    thread.start()
    return thread


def end_with_parent(link: socket.socket) -> None:
    """End this process as soon as the other end of `link` is closed, as it is when the parent ends or wants so.

    The kernel's own signal for that (PR_SET_PDEATHSIG) comes when the thread ends that has started the process.
    """

    def watch() -> None:
        while link.recv(1):
            pass
        os._exit(_PARENT_GONE)

    threading.Thread(target=watch, name="lightpage-parent", daemon=True).start()


def telling(link: socket.socket) -> Progress:
    """Return what tells the parent of each step, in a line of JSON."""
    return lambda name, fraction: link.sendall(json.dumps([name, fraction]).encode() + b"\n")


def main(folder: str) -> None:
    """Work at low priority until done, or until the parent is gone."""
    link = parent_link()
    end_with_parent(link)
    yield_to_reads()
    yield_more()
    work(WorkFolder(Path(folder)), telling(link))


if __name__ == "__main__":
    main(sys.argv[1])
