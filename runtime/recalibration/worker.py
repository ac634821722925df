"""The work of a recalibration's process, which `separate_process` starts."""

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from lightpage.clock import SYSTEM, Clock
from lightpage.helper_process import Helper
from lightpage.progress import Progress
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import NoTracker, TrackerMemory
from lightpage.runtime.recalibration.healed_bundle import recalibrate_by_lost
from lightpage.runtime.recalibration.healing import LostPages
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, Refit, recalibrate
from lightpage.runtime.recalibration.refit import refit
from lightpage.runtime.recalibration.separate_process import THREADS

NICENESS = 10
"""Beside reads without a pause such a process gets a tenth of a core, and ends. With a higher niceness it would starve,
as it would under SCHED_IDLE."""

LOWEST = 19
"""Its niceness once reads have been found to leave it room: it then does with what they leave."""

ROOM = 0.3
"""Share of a core that it has had lately, from which on they do."""

_LOOK_S = 1.0


def yield_to_reads() -> None:
    """Take what processor time reads leave, as far as the system lets a process ask for that."""
    with suppress(OSError):
        os.nice(NICENESS)
    lower_session(NICENESS)
    if hasattr(os, "SCHED_BATCH"):
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def lower_session(niceness: int) -> None:
    """Lower this process's session too: Linux may share cores among sessions first, where the service has its own."""
    with suppress(OSError):
        Path("/proc/self/autogroup").write_text(f"{niceness}\n")


def yield_more(clock: Clock = SYSTEM, worked: Callable[[], float] = time.process_time) -> threading.Thread:
    """Yield all to reads, from a thread, as soon as they leave room.

    There is no way back: who has not the right to it cannot raise a priority. Where reads leave no pause later on, the
    work runs into its limit of time, and the next one begins as this one did.

    Args:
        clock: clock by which the time passes over which it is taken.
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
        lower_session(LOWEST)

    thread = threading.Thread(target=watch, name="lightpage-priority", daemon=True)
    thread.start()
    return thread


class RecalibrationWorker(Helper):
    """Recalibrates at a low priority.

    Attributes:
        fit: how to fit.
    """

    fit: Refit = staticmethod(refit)

    def __init__(self) -> None:
        yield_to_reads()
        yield_more()

    def recalibrate(
        self,
        bundle: Bundle,
        pages: KnownPages | LostPages,
        out: Path,
        version: str,
        memory: TrackerMemory | None,
        steps: int | None,
        progress: Progress,
    ) -> RecalibrationOutcome:
        """Recalibrate a model; see `recalibrate` and `recalibrate_by_lost`.

        Args:
            bundle: bundle of the model.
            pages, out, version, progress: see `recalibrate`.
            memory: what the model's tracker has learnt; None where the image is not followed.
            steps: largest number of Gauss-Newton steps of a page, as in the service; None for no limit.
        """
        decoder = Decoder(bundle, THREADS, steps=steps)
        tracker = NoTracker(decoder) if memory is None else tracker_for(decoder, memory)
        if isinstance(pages, LostPages):
            return recalibrate_by_lost(decoder, pages, out, version, self.fit, progress, tracker)
        return recalibrate(decoder, pages, out, version, self.fit, progress, tracker)
