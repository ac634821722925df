"""Findings of a bulk run, added up from its shards one after the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from lightpage.codec.volume_file import ranges
from lightpage.metrics.reliability import ConfidenceBin, calibration_error
from lightpage.runtime.archives.run.job import Job, Source
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.shard import BUNDLE, PageRecord, PageState, ShardRecord, with_end
from lightpage.runtime.archives.run.task import NamedBundle, Operation, Problem, Task

AIR, CONFIRMED = "air_bits_per_symbol", "confirmed_bits"

UNKNOWN = "unknown"
"""Cause of a loss that has none."""

TOLD = 5
"""Lost pages that are told with their reasons."""


class DeviceState(StrEnum):
    """Outcome of a device that was to be recalibrated."""

    RECALIBRATED = "recalibrated"
    REFUSED = "refused"
    """It stays as it is: its pages fit no geometry, or the new model would read them worse."""
    FAILED = "failed"
    """The next run tries it again."""
    MISSING = "missing"
    """It was not come to."""


class Mean:
    """A mean that holds no values, and the least of them; None of no values."""

    def __init__(self) -> None:
        self._sum, self._count = 0.0, 0
        self.least: float | None = None

    def add(self, value: float | None) -> None:
        """Count a value, if it is one."""
        if value is not None:
            self._sum, self._count = self._sum + value, self._count + 1
            self.least = value if self.least is None else min(self.least, value)

    @property
    def value(self) -> float | None:
        """None of no values."""
        return self._sum / self._count if self._count else None


class Means(dict[str, Mean]):
    """Means of the figures of pages, by name; of a figure that no page has, a mean of nothing."""

    def __missing__(self, name: str) -> Mean:
        return Mean()

    def add(self, figures: Mapping[str, float | int | None]) -> None:
        """Count a page."""
        for name, value in figures.items():
            self.setdefault(name, Mean()).add(value)

    def to_json(self) -> dict[str, float | None]:
        """All of them."""
        return {name: mean.value for name, mean in self.items()}


@dataclass
class Counts:
    """Counts of pages, of a recording or of all.

    Attributes:
        pages: all of them; of a fleet that is recalibrated, its devices.
        read, left_out: how many were.
        lost: lost pages by cause.
        healed: read, by a model that was healed.
        recalibration_due: read, and show that the device has changed.
        models: pages by the version of what read them.
        figures: figures of those that were read.
    """

    pages: int = 0
    read: int = 0
    left_out: int = 0
    lost: Counter[str] = field(default_factory=Counter)
    healed: int = 0
    recalibration_due: int = 0
    models: Counter[str] = field(default_factory=Counter)
    figures: Means = field(default_factory=Means)

    @property
    def missing(self) -> int:
        """Pages without a result."""
        return self.pages - self.read - self.left_out - self.lost.total()

    def add(self, page: PageRecord, version: str) -> None:
        """Count a page that has a result, by the version of what read it."""
        self.models[version] += 1
        self.left_out += page.state is PageState.LEFT_OUT
        if page.state is PageState.LOST:
            self.lost[page.loss or UNKNOWN] += 1
        if page.state is PageState.READ:
            self.read += 1
            self.healed += page.figures.get("healed_rounds") is not None
            self.recalibration_due += page.recalibration_due
            confirmed = {} if page.confirmed_bits is None else {CONFIRMED: page.confirmed_bits}
            self.figures.add({**page.figures, **confirmed})

    def counts_json(self) -> dict[str, Any]:
        """The counts under the names that other programs read."""
        return {
            "pages": self.pages,
            "pages_read": self.read,
            "pages_left_out": self.left_out,
            "pages_lost": self.lost.total(),
            "pages_missing": self.missing,
            "lost": dict(self.lost),
            "pages_healed": self.healed,
            "pages_recalibration_due": self.recalibration_due,
        }


@dataclass
class Round:
    """Gains of a later reading.

    Attributes:
        model: what read.
        pages: pages that were read again.
        pages_won: number of pages that were lost before, and are read now.
        pages_better: number of pages that were read before, and are read better now.
        pages_lost_still: number of pages that are lost still.
        air_before, air_after: mean AIR of all of them where it is known, a lost page counting nothing.
    """

    model: NamedBundle
    pages: int = 0
    pages_won: int = 0
    pages_better: int = 0
    pages_lost_still: int = 0
    air_before: Mean = field(default_factory=Mean)
    air_after: Mean = field(default_factory=Mean)

    def add(self, before: PageRecord, now: PageRecord) -> None:
        """Count a page that was read again."""
        took = now.better_than(before)
        self.pages += 1
        self.pages_won += took and before.state is PageState.LOST
        self.pages_better += took and before.state is PageState.READ
        self.pages_lost_still += not took and before.state is PageState.LOST
        if AIR in now.figures or AIR in before.figures:
            self.air_before.add(_air(before))
            self.air_after.add(_air(now if took else before))

    def to_json(self) -> dict[str, Any]:
        """The figures under the names that other programs read."""
        counts = {name: count for name, count in vars(self).items() if isinstance(count, int)}
        means = {"air_before": self.air_before.value, "air_after": self.air_after.value}
        return {"version": self.model.version, **counts, **means}


@dataclass(frozen=True)
class Reading:
    """A range that a worker has done, in whichever round.

    Attributes:
        finished_s: when, seconds since 1970.
        seconds: time that it took.
        pages: how many, or one device.
        worker: who did it.
        read_bytes: bytes read of frames, as they lie in the recording.
    """

    finished_s: float
    seconds: float
    pages: int
    worker: str
    read_bytes: int

    @classmethod
    def of(cls, record: ShardRecord, pages: int) -> Reading:
        """Return the reading of a shard."""
        return cls(record.finished_s, record.seconds, pages, record.worker, record.read_bytes)


@dataclass
class Group(Counts):
    """Findings of a device, or of a recording where there is no fleet.

    Attributes:
        recordings: recordings that it has.
        told: the first problem that anything of it had, for people; empty without one.
    """

    recordings: int = 0
    told: str = ""


@dataclass
class Totals(Counts):
    """Findings of a run.

    Attributes:
        confidence_bins: bins of confidence of all pages of an evaluation together.
        rounds: what later readings have brought.
        recordings: a row each, unless devices are recalibrated.
        devices: a row each, where they are.
        told: the first lost pages, or devices, and why.
        examples: the first one of each cause.
        groups: groups by device, unless devices are recalibrated; by recording where there is no fleet.
        readings: all ranges that were done, a few numbers each.
    """

    confidence_bins: dict[tuple[float, float], list[float]] = field(default_factory=dict)
    rounds: list[Round] = field(default_factory=list)
    recordings: list[dict[str, Any]] = field(default_factory=list)
    devices: list[dict[str, Any]] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    examples: dict[str, str] = field(default_factory=dict)
    groups: dict[str, Group] = field(default_factory=dict)
    readings: list[Reading] = field(default_factory=list)

    @property
    def ece(self) -> float | None:
        """Return the expected calibration error of an evaluation."""
        bins = [
            ConfidenceBin(low, high, int(count), claimed / count, right / count)
            for (low, high), (count, claimed, right) in self.confidence_bins.items()
        ]
        return calibration_error(bins) if bins else None

    def to_json(self) -> dict[str, Any]:
        """The figures under the names that other programs read."""
        return {
            **self.counts_json(),
            "models": dict(self.models),
            "figures": {**self.figures.to_json(), **({} if self.ece is None else {"ece": self.ece})},
            "rounds": [each.to_json() for each in self.rounds],
            **({"devices": self.devices} if self.devices else {"recordings": self.recordings}),
        }


def totals(ledger: Ledger, job: Job, failures: Mapping[tuple[str, Path], Problem] | None = None) -> Totals:
    """Add up what the shards of a job say, or of the ledger's part of it; a shard is read at a time.

    Args:
        ledger: ledger of the job.
        job: what was asked.
        failures: why devices have no result, see `lightpage.runtime.archives.run.driver.Progressed`.

    Raises:
        InvalidInputError: a shard cannot be read.
    """
    found = Totals(rounds=[Round(model) for model in job.rounds])
    if job.choices.operation is Operation.RECALIBRATE:
        for index, own in ledger.part.devices(job):
            _add_device(found, ledger, index, own, failures or {})
        return found
    for index, source in ledger.part.sources(job):
        _add_recording(found, ledger, job, index, source)
    return found


def _add_device(
    found: Totals, ledger: Ledger, index: int, own: tuple[Source, ...], failures: Mapping[tuple[str, Path], Problem]
) -> None:
    shard, first = ledger.shard(index, 0), own[0]
    row: dict[str, Any] = {"device": first.device, "recordings": [str(source.path) for source in own]}
    problem = next((source.problem for source in own if source.problem is not None), None)
    if problem is None:
        found.pages += 1
        problem = failures.get((first.device, first.path))
    if ledger.recalibrated(index):
        record = ShardRecord.read(shard)
        page = record.pages[0]
        found.add(page, record.model.version)
        found.readings.append(Reading.of(record, 1))
        state = DeviceState.RECALIBRATED if page.state is PageState.READ else DeviceState.REFUSED
        row |= {"state": state, "air_before": None, "air_after": None, **record.summary, "reason": page.reason}
        if state is DeviceState.RECALIBRATED:
            row["bundle"] = str(with_end(shard, BUNDLE))
        else:
            _tell_lost(found, page, f"{_recording(first)}: {page.reason}")
    else:
        state = DeviceState.MISSING if problem is None else DeviceState.FAILED
        row |= {"state": state, "reason": "" if problem is None else str(problem)}
    found.devices.append(row)


def _add_recording(found: Totals, ledger: Ledger, job: Job, index: int, source: Source) -> None:
    own, there = Counts(), ledger.results(index)
    lost: dict[str, list[int]] = {}
    group = found.groups.setdefault(source.device or str(source.path), Group())
    group.recordings += 1
    if source.problem is not None:
        group.told = group.told or str(source.problem)
    for task in ledger.ranges(job, index, source):
        for counts in (own, group, found):
            counts.pages += task.weight
        for record, page in _pages(found, ledger, job, index, task, there):
            for counts in (own, group, found):
                counts.add(page, record.model.version)
            if page.state is PageState.LOST:
                lost.setdefault(page.loss or UNKNOWN, []).append(page.page)
                group.told = group.told or page.reason
                _tell_lost(found, page, f"{_recording(source)}: page {page.page}: {page.reason}")
    row = {"device": source.device, "recording": str(source.path), **own.counts_json()}
    row |= {"lost_pages": {cause: ranges(pages) for cause, pages in lost.items()}, "figures": own.figures.to_json()}
    if source.problem is not None:
        row["problem"] = str(source.problem)
    found.recordings.append(row)


def _pages(
    found: Totals, ledger: Ledger, job: Job, index: int, task: Task, there: frozenset[str]
) -> Iterator[tuple[ShardRecord, PageRecord]]:
    """The readings that count of the pages of a range, each with the shard that it is from; rounds are counted."""
    best: dict[int, tuple[ShardRecord, PageRecord]] = {}
    readings = ledger.readings(index, task.pages[0], there, 1 + len(job.rounds))
    if 0 not in readings:  # it is read again, and what a later round found of its pages cannot be compared
        return
    for number, shard in readings.items():
        record = ShardRecord.read(shard)
        found.readings.append(Reading.of(record, len(record.pages)))
        for part in record.confidence_bins if number == 0 else ():
            sums = found.confidence_bins.setdefault((part.low, part.high), [0.0, 0.0, 0.0])
            for place, value in enumerate((part.count, part.count * part.confidence, part.count * part.accuracy)):
                sums[place] += value
        for page in record.pages:
            if number:
                found.rounds[number - 1].add(best[page.page][1], page)
            if number == 0 or page.better_than(best[page.page][1]):
                best[page.page] = record, page
    yield from best.values()


def _tell_lost(found: Totals, page: PageRecord, told: str) -> None:
    found.examples.setdefault(page.loss or UNKNOWN, told)
    if len(found.told) < TOLD:
        found.told.append(told)


def _recording(source: Source) -> str:
    device = f"device {source.device}: " if source.device else ""
    return f"{device}recording {source.path}"


def _air(page: PageRecord) -> float:
    return float(page.figures.get(AIR) or 0.0) if page.state is PageState.READ else 0.0
