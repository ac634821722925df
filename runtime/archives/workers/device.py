"""A device that a worker recalibrates: re-fitted, or trained on too, from known pages of its own."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TypeVar

from lightpage.errors import CalibrationError, FrameError, InvalidInputError, RecalibrationRefusedError
from lightpage.progress import State, reporting
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.read_pages import write_read_pages
from lightpage.runtime.archives.recordings.recovery import code_of
from lightpage.runtime.archives.run.shard import BUNDLE, LOG, TRAINING, Findings, PageRecord, PageState, with_end
from lightpage.runtime.archives.run.task import Step, Task
from lightpage.runtime.archives.workers.fine_tuning import DeepRecalibration
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.healed_bundle import recalibrate_by_recording
from lightpage.runtime.recalibration.recalibration import Refit, next_version

T = TypeVar("T")

EVERY_S = 30.0
"""Seconds from one line of a step to the next."""

_KNOWN = "known.h5"
_TOLD = ("version", "previous_version", "air_before", "air_after", "air_limit", "pages_used", "pages_held_back")
"""What a device's record has of the outcome, beside the angle."""

_REFUSED = (RecalibrationRefusedError, CalibrationError, InvalidInputError)
_REFUSED_DEEPLY = (RecalibrationRefusedError, CalibrationError, FrameError)
"""What a deep recalibration finds of a device; anything else is tried again by the next run."""


def recalibrated(
    task: Task,
    recording: Recording,
    decoder: Decoder,
    fit: Refit,
    deep: Callable[[], DeepRecalibration],
    tell: Callable[[Step], None],
) -> Findings:
    """Return the outcome of a device; pages that fit no geometry are one too. A deep recalibration is resumed.

    Args:
        task: which device.
        recording: recording with its known pages, or pages of user data.
        decoder: decoder of its bundle.
        fit, deep, tell: see `lightpage.runtime.archives.workers.work.Worker`.

    Raises:
        LightpageError: something that says nothing of the device.
    """
    tuning, pages = task.choices.fine_tuning, len(task.pages)
    findings = _REFUSED if tuning is None else _REFUSED_DEEPLY
    out = with_end(task.shard, BUNDLE)
    out.unlink(missing_ok=True)  # of a worker that was killed before it wrote the record
    try:
        if tuning is None:
            code, version = partial(code_of, recording, decoder.bundle), next_version(decoder.version)
            outcome = recalibrate_by_recording(decoder, recording, pages, code, out, version, fit, lambda *_: None)
        else:
            if task.run is None:
                expected = "the training run that its bundle was made from"
                raise InvalidInputError(f"device {task.device}", "no run", expected)
            name = task.device or task.name
            log = StepLog(with_end(task.shard, LOG), lambda what: tell(Step(device=name, what=what)))
            with reporting(log), ExitStack() as stack:
                folder = with_end(task.shard, TRAINING)
                if not (known := recording).has_symbols:
                    known = stack.enter_context(_read(recording, decoder, folder, pages))
                outcome = deep().recalibrate(decoder, known, task.run, folder, out, tuning, pages, log.progress)
    except findings as error:
        lost = PageRecord(page=0, state=PageState.LOST, loss=type(error).__name__, reason=str(error))
        return Findings(pages=(lost,))
    summary = {name: getattr(outcome, name) for name in _TOLD} | {"angle_deg": outcome.report.angle_deg}
    return Findings(pages=(PageRecord(page=0, state=PageState.READ),), summary=summary)


def _read(recording: Recording, decoder: Decoder, folder: Path, most: int) -> Recording:
    """Pages of user data that were read, as known ones; kept in `folder`, where they are not read again."""
    path = folder / _KNOWN
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_read_pages(decoder, recording, code_of(recording, decoder.bundle), path, most)
    return Recording.open(path)


class StepLog:
    """Tells of steps in lines; see `lightpage.progress.Reporter`.

    Args:
        path: path of the log, which is gone on with.
        tell: called with each line.
        clock: clock by which lines are told now and then.
    """

    def __init__(self, path: Path, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._tell, self._clock = path, tell, clock
        self._step, self._next = "", 0.0

    def track(
        self, items: Iterable[T], what: str, unit: str, total: int | None, done: int, state: State
    ) -> Iterator[T]:
        """See `Reporter`."""
        number = done
        for number, item in enumerate(items, done + 1):
            yield item
            self._now(what, f"{unit} {number}" + (f" of {total}" if total else ""), state)
        self.note(f"{what}: {number} {unit}s" + (f", {state()}" if state() else ""))

    def note(self, what: str) -> None:
        """See `Reporter`."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {what}\n")
        self._tell(what)

    def progress(self, step: str, share: float) -> None:
        """See `lightpage.progress.Progress`."""
        self._now(step, f"{share:.0%}", lambda: "")

    def _now(self, step: str, where: str, state: State) -> None:
        """A line when a step begins, and then one every so often."""
        if step == self._step and self._clock() < self._next:
            return
        self._step, self._next = step, self._clock() + EVERY_S
        self.note(f"{step}: {where}" + (f", {state()}" if state() else ""))
