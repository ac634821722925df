"""The folder of a bulk run: what was asked, which ranges are done, and what became of every page."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Self

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import InvalidInputError, SurroundingsError, TakenError
from lightpage.failures import os_errors, os_failure
from lightpage.files import check_utf8, lock
from lightpage.runtime.archives.run.job import Job, Source
from lightpage.runtime.archives.run.shard import RECORD, PageRecord, ShardRecord, holds_losses
from lightpage.runtime.archives.run.task import Operation, Plain, RecordedFile, Task
from lightpage.systems import open_file

_LOCKING = "HDF5_USE_FILE_LOCKING"
"""Variable of the environment by which HDF5, and this, are told to go without locks."""

_LOCK, _QUESTION, _SHARDS = "lock", "lock-job", "shards"
_WRITABLE = "a folder that can be written"

_AGAIN = ".again-"
"""In the names of shards of later rounds."""

_QUESTION_S, _AGAIN_S = 600.0, 0.1
"""Longest wait for another part that writes down what is asked, and the time between two tries."""


class Part(Plain):
    """Every `count`th recording from `index`; of a fleet, every `count`th device with all its recordings.

    Attributes:
        index: index from 0.
        count: how many parts there are.
    """

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Part:
        """A part as users write it: K/N.

        Raises:
            InvalidInputError: it is none.
        """
        match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
        if match is None or not int(match[1]) < int(match[2]):
            raise InvalidInputError("--part", repr(text), "K/N with K from 0 to N - 1")
        return cls(index=int(match[1]), count=int(match[2]))

    def sources(self, job: Job) -> Iterator[tuple[int, Source]]:
        """Return its recordings, each with its place among the run's."""
        for place, own in self.devices(job):
            yield from enumerate(own, place)

    def devices(self, job: Job) -> Iterator[tuple[int, tuple[Source, ...]]]:
        """Recordings of each of its devices; see `lightpage.runtime.archives.run.job.Job.devices`."""
        return islice(job.devices.items(), self.index, None, self.count)

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


WHOLE = Part(index=0, count=1)
"""All of it."""


class Ledger:
    """The folder of a run; in a `with` statement it belongs to this process, or a part of its recordings does.

    Args:
        folder: folder of the run, there or yet to be made.
        part: part of the run that this process does.
        clock: clock that bounds the wait for another part.

    Attributes:
        doubted: paths of shards whose ranges are read again; until then they count as having no result.

    Raises:
        TakenError: another run is at work there, or on this part of it.
        InvalidInputError: the folder cannot be written, or its name is not UTF-8.
    """

    def __init__(self, folder: Path, part: Part = WHOLE, clock: Clock = SYSTEM) -> None:
        self.folder, self.part, self._clock = folder.absolute(), part, clock
        self.doubted: set[Path] = set()
        check_utf8(self.folder, "bulk run")
        self._subject = f"bulk run {self.folder}"

    def __enter__(self) -> Self:
        with os_errors(self._subject, _WRITABLE):
            self.folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            if self.part == WHOLE:
                stack.callback(os.close, self._locked(_LOCK))
            else:
                stack.callback(os.close, self._locked(_LOCK, shared=True))
                stack.callback(os.close, self._locked(f"{_LOCK}-{self.part.index}"))
            self._locks = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._locks.close()

    @contextmanager
    def question(self) -> Iterator[None]:
        """No other part reads or writes what is asked.

        Raises:
            TakenError: another one has not ended with it in time.
        """
        until, asking = self._clock.now() + _QUESTION_S, None
        while asking is None:
            try:
                asking = self._locked(_QUESTION)
            except TakenError:
                if self._clock.now() > until:
                    raise
                self._clock.sleep(_AGAIN_S)
        try:
            yield
        finally:
            os.close(asking)

    def _locked(self, name: str, *, shared: bool = False) -> int:
        """A descriptor that holds a lock until it is closed.

        Raises:
            TakenError: another run holds it.
            SurroundingsError: the storage has no locks, and nobody has said that this does not matter.
        """
        subject = f"lock {self.folder / name}"
        with os_errors(self._subject, _WRITABLE):
            descriptor = open_file(self.folder / name)
        try:
            if not lock(descriptor, subject, shared=shared) and os.environ.get(_LOCKING) not in ("FALSE", "0"):
                expected = f"storage that has locks, or {_LOCKING}=FALSE where no other run is at work there"
                raise SurroundingsError(subject, os.strerror(errno.ENOLCK), expected)
        except BaseException as error:
            os.close(descriptor)
            if isinstance(error, BlockingIOError):
                raise TakenError(self._subject, "another run at work there", "its end, or another folder") from None
            raise
        return descriptor

    def sweep(self, job: Job) -> None:
        """Remove what workers that were killed have left half-written; none of this part may be at work."""
        for index, _ in self.part.sources(job):
            for left in self.shard(index, 0).parent.glob(".*"):
                shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)

    def shard(self, source: int, first: int, number: int = 0) -> Path:
        """Path of a range's result, without the end of its name.

        Args:
            source: place of the recording among the run's.
            first: the range's first page.
            number: number of the round, 0 for the first reading.
        """
        again = f"{_AGAIN}{number}" if number else ""
        return self.folder / _SHARDS / f"{source:06d}" / f"{first:08d}{again}"

    def missing(self, job: Job) -> Iterator[Task]:
        """Ranges of the first reading that have no result, recording by recording; or such devices."""
        if job.choices.operation is Operation.RECALIBRATE:
            for index, own in self.part.devices(job):
                if self.recalibrated(index) or any(each.problem is not None for each in own):
                    continue
                shard = self.shard(index, 0)
                make_folder(shard.parent)
                count = job.choices.device_pages or sum(each.pages for each in own)
                yield _task(job, own, tuple(range(count)), shard)
            return
        for index, source in self.part.sources(job):
            there = self.results(index)
            for task in self.ranges(job, index, source):
                if task.shard.name not in there:
                    make_folder(task.shard.parent)
                    yield task

    def missing_again(self, job: Job, number: int) -> Iterator[Task]:
        """Pages that were not read well before a round, and have no result in it, range by range.

        Args:
            job: job with that round.
            number: number of the round, from 1.

        Raises:
            InvalidInputError: a shard that cannot be read.
        """
        for index, source in self.part.sources(job):
            there = self.results(index)
            for task in self.ranges(job, index, source):
                shard = self.shard(index, task.pages[0], number)
                if task.shard.name not in there or shard.name in there:
                    continue
                known = self.pages(index, task.pages[0], there, number)
                if poor := tuple(page.page for page in known if not page.well):
                    yield task.model_copy(update={"pages": poor, "bundle": job.rounds[number - 1], "shard": shard})

    def pages(self, source: int, first: int, there: frozenset[str], rounds: int) -> list[PageRecord]:
        """Return what is known of the pages of a range that was read: the reading of each that counts.

        Args:
            source, first: the range.
            there: see `results`.
            rounds: how many readings are looked at.

        Raises:
            InvalidInputError: a shard that cannot be read.
        """
        best: dict[int, PageRecord] = {}
        for shard in self.readings(source, first, there, rounds).values():
            for page in ShardRecord.read(shard).pages:
                if page.page not in best or page.better_than(best[page.page]):
                    best[page.page] = page
        return list(best.values())

    def readings(self, source: int, first: int, there: frozenset[str], rounds: int) -> dict[int, Path]:
        """Paths of the results of a range by their rounds; arguments as for `pages`."""
        shards = {number: self.shard(source, first, number) for number in range(rounds)}
        return {number: shard for number, shard in shards.items() if shard.name in there}

    def ranges(self, job: Job, index: int, source: Source) -> Iterator[Task]:
        """All ranges of a recording, whether they are done or not; none of one that could not be opened."""
        step, count = job.choices.range_pages, source.pages
        for first in range(0, count, step):
            pages = tuple(range(first, min(first + step, count)))
            yield _task(job, (source,), pages, self.shard(index, first))

    def doubt_losses(self, job: Job) -> None:
        """Have ranges read again that have lost pages.

        Raises:
            StorageError, InvalidInputError: a shard that cannot be read.
        """
        for index, _ in self.part.sources(job):
            folder = self.shard(index, 0).parent
            for name in self.results(index):
                if _AGAIN not in name and holds_losses(folder / name):
                    self.doubted.add(folder / name)

    def recalibrated(self, place: int) -> bool:
        """Return whether a device has a result, by the place of its first recording."""
        return self.shard(place, 0).name in self.results(place)

    def results(self, source: int) -> frozenset[str]:
        """Names of the shards that a recording has, but for those that are doubted."""
        folder = self.shard(source, 0).parent
        try:
            names = (name.removesuffix(RECORD) for name in os.listdir(folder) if name.endswith(RECORD))
            return frozenset(name for name in names if folder / name not in self.doubted)
        except FileNotFoundError:
            return frozenset()
        except OSError as error:
            raise os_failure(f"folder {folder}", error, "a folder that can be read") from None


def _task(job: Job, own: tuple[Source, ...], pages: tuple[int, ...], shard: Path) -> Task:
    """Return what is done with pages of recordings that could be opened."""
    first = own[0]
    return Task(
        choices=job.choices,
        device=first.device,
        files=tuple(RecordedFile(path=each.path, stamp=each.stamp) for each in own if each.stamp is not None),
        pages=pages,
        bundle=job.bundles[first.bundle],
        shard=shard,
        run=first.run,
    )


def make_folder(folder: Path) -> None:
    """Make a folder, and those that it lies in, unless it is there."""
    with os_errors(f"folder {folder}", _WRITABLE):
        folder.mkdir(parents=True, exist_ok=True)
