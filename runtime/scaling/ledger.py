"""The folder of a bulk run: what was asked, which ranges are done, and what became of every page."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from lightpage.errors import BusyError, InvalidInputError
from runtime.scaling.job import KNOWN_PAGES, Job, Source
from runtime.scaling.shard import RECORD, PageRecord, ShardRecord
from runtime.scaling.task import Operation, RecordedFile, Task

_LOCK, _SHARDS = "lock", "shards"


class Ledger:
    """The folder of a run; in a `with` statement it belongs to this process.

    Args:
        folder: of the run, there or yet to be made.

    Raises:
        BusyError: another run is at work there.
        InvalidInputError: the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()

    def __enter__(self) -> Self:
        subject = f"bulk run {self.folder}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self.folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise InvalidInputError(subject, error, "a folder that can be written") from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            raise BusyError(subject, "another run at work there", "its end, or another folder") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._lock)

    def sweep(self) -> None:
        """Remove what workers that were killed have left half-written; none may be at work."""
        for left in (self.folder / _SHARDS).glob("*/.*"):
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)

    def shard(self, source: int, first: int, number: int = 0) -> Path:
        """Path of a range's result, without the end of its name.

        Args:
            source: place of the recording among the run's.
            first: the range's first page.
            number: of the round, 0 for the first reading.
        """
        again = f".again-{number}" if number else ""
        return self.folder / _SHARDS / f"{source:06d}" / f"{first:08d}{again}"

    def missing(self, job: Job) -> Iterator[Task]:
        """Ranges of the first reading that have no result, recording by recording; or such devices."""
        if job.choices.operation is Operation.RECALIBRATE:
            for index, own in job.devices.items():
                device = self._device(job, index, own)
                if device is not None and device.shard.name not in self.results(index):
                    yield device
            return
        for index, source in enumerate(job.sources):
            there = self.results(index)
            yield from (task for task in self.ranges(job, index, source) if task.shard.name not in there)

    def missing_again(self, job: Job, number: int) -> Iterator[Task]:
        """Pages that were not read well before a round, and have no result in it, range by range.

        Args:
            job: with that round.
            number: of the round, from 1.

        Raises:
            InvalidInputError: a shard that cannot be read.
        """
        for index, source in enumerate(job.sources):
            there = self.results(index)
            for task in self.ranges(job, index, source):
                shard = self.shard(index, task.pages[0], number)
                if task.shard.name not in there or shard.name in there:
                    continue
                known = self.pages(index, task.pages[0], there, number)
                if poor := tuple(page.page for page in known if not page.well):
                    yield task.model_copy(update={"pages": poor, "bundle": job.rounds[number - 1], "shard": shard})

    def pages(self, source: int, first: int, there: frozenset[str], rounds: int) -> list[PageRecord]:
        """What is known of the pages of a range that was read: the reading of each that counts.

        Args:
            source, first: the range.
            there: see `results`.
            rounds: how many readings are looked at.

        Raises:
            InvalidInputError: a shard that cannot be read.
        """
        best = {page.page: page for page in ShardRecord.read(self.shard(source, first)).pages}
        for number in range(1, rounds):
            shard = self.shard(source, first, number)
            for page in ShardRecord.read(shard).pages if shard.name in there else ():
                if page.better_than(best[page.page]):
                    best[page.page] = page
        return list(best.values())

    def ranges(self, job: Job, index: int, source: Source) -> Iterator[Task]:
        """All ranges of a recording, whether they are done or not."""
        choices = job.choices
        if source.stamp is None:
            return
        count, step = source.pages, choices.range_pages
        for first in range(0, count, step):
            yield Task(
                operation=choices.operation,
                device=source.device,
                recording=source.path,
                stamp=source.stamp,
                pages=tuple(range(first, min(first + step, count))),
                bundle=job.bundles[source.bundle],
                shard=self.shard(index, first),
                tracking=choices.tracking,
                symbols=choices.symbols,
            )

    def _device(self, job: Job, index: int, own: tuple[Source, ...]) -> Task | None:
        """The task of a device, whose first recording has this place; None where something of it is lacking."""
        if any(each.problem is not None for each in own):
            return None
        choices, (first, *others) = job.choices, own
        count = choices.known_pages or (KNOWN_PAGES if choices.fine_tuning is None else sum(each.pages for each in own))
        assert first.stamp is not None  # it has no problem
        return Task(
            operation=choices.operation,
            device=first.device,
            recording=first.path,
            stamp=first.stamp,
            pages=tuple(range(count)),
            bundle=job.bundles[first.bundle],
            shard=self.shard(index, 0),
            more=tuple(RecordedFile(path=each.path, stamp=each.stamp) for each in others if each.stamp is not None),
            run=first.run,
            fine_tuning=choices.fine_tuning,
        )

    def results(self, source: int) -> frozenset[str]:
        """Names of the shards that a recording has."""
        folder = self.shard(source, 0).parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
            return frozenset(name.removesuffix(RECORD) for name in os.listdir(folder) if name.endswith(RECORD))
        except OSError as error:
            raise InvalidInputError(f"folder {folder}", error, "a folder that can be written") from None
