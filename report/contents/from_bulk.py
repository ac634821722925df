"""A report's contents from the folder of a bulk run, finished or not; nothing in it is changed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lightpage.codec.page_bytes import LOSSES, Loss
from lightpage.codec.volume_file import ranges
from lightpage.errors import InvalidInputError
from lightpage.report.words import how_long, number
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.task import NamedBundle, Operation
from lightpage.runtime.archives.run.totals import AIR, CONFIRMED, DeviceState, Group, Reading, Totals, totals
from lightpage.runtime.archives.run.volumes import known_files
from lightpage.words import counted

MARGIN = "margin_bits"
MEASURES = {AIR: "AIR", MARGIN: "margin", CONFIRMED: "confirmed by pilots"}
"""Figures of a device, bits a symbol, where it is known."""
PAUSE_S = 15.0
"""Longest pause in which a run counts as going on."""
LISTED = 200
"""Devices, workers or files that are listed; the worst, or the first, of more."""
_NAMED = 20
"""Parts of an enumeration."""
PAGES, DEVICES = "pages", "devices"
_LOST = {PAGES: "lost", DEVICES: "refused"}


@dataclass(frozen=True)
class Device:
    """A device, or a recording where there is no fleet.

    Attributes:
        name: name of the device.
        group: findings about the device.
        told: first problem of the device, for people.
    """

    name: str
    group: Group
    told: str

    def text(self, measure: str, *, least: bool = False) -> str:
        """A mean, or the least, of its pages; empty where it is not known."""
        figures = self.group.figures
        value = figures[measure].least if least else figures[measure].value
        return "" if value is None else number(value, 3)

    @property
    def losses(self) -> str:
        """Pages lost by cause, for people."""
        return ", ".join(f"{count:,} {cause}" for cause, count in self.group.lost.most_common())


@dataclass(frozen=True)
class Recalibration:
    """Outcome of a device's recalibration.

    Attributes:
        name: name of the device, or its recording where there is no fleet.
        recordings: number of the device's recordings.
        state: state of the recalibration, in a word.
        air_before: AIR by the bundle before, bit/symbol; None where it is not known.
        air_after: AIR by the new bundle.
        version: version of the new bundle; empty without one.
        reason: why there is none, for people.
    """

    name: str
    recordings: int
    state: DeviceState
    air_before: float | None
    air_after: float | None
    version: str
    reason: str


@dataclass(frozen=True)
class Worker:
    """Work done by one worker.

    Attributes:
        name: host and process.
        ranges, pages: how many.
        seconds: time that it took for them.
    """

    name: str
    ranges: int
    pages: int
    seconds: float


@dataclass(frozen=True)
class File:
    """A file of a run that recovers user bytes.

    Attributes:
        volume: number of the volume.
        size: size in bytes.
        result: outcome of the file, for people.
        whole: whether all of it is there.
    """

    volume: int
    size: int
    result: str
    whole: bool


@dataclass(frozen=True)
class BulkData:
    """Everything that the report of a bulk run shows.

    Attributes:
        title: title of the page.
        told: how the run stands, in a sentence or two.
        cards: the figures that matter most, (name, value, unit).
        facts: the others, (name, value).
        unit: name of the pieces of the work, in the plural: pages or devices.
        found: findings of the run.
        causes: causes of losses: cause, how many, their share of all, and the first one.
        devices: the worst first; none where devices are recalibrated.
        fleet: whether these are devices of a fleet.
        recalibrations: recalibrations of devices, the worst first; None of another operation.
        workers: the busiest first.
        files: files of a recovery; None where no run has ended yet, or of another operation.
    """

    title: str
    told: str
    cards: list[tuple[str, str, str]]
    facts: list[tuple[str, str]]
    unit: str
    found: Totals
    causes: list[tuple[str, int, float, str]]
    devices: list[Device]
    fleet: bool
    recalibrations: list[Recalibration] | None
    workers: list[Worker]
    files: list[File] | None

    @property
    def measures(self) -> list[str]:
        """Names of the known ones of `MEASURES`."""
        return [name for name in MEASURES if self.found.figures[name].value is not None]

    @property
    def lost(self) -> str:
        """Word for pages, or devices, that are not read."""
        return _LOST[self.unit]

    @property
    def summary(self) -> str:
        """Headline figures, in a few words."""
        found = self.found
        done = f"{found.pages - found.missing:,} of {found.pages:,} {self.unit} done"
        return f"{done}, {found.lost.total():,} {self.lost}"


def report_of_bulk(folder: Path) -> BulkData:
    """Add up what a bulk run has done until now; one that is at work is not disturbed.

    Raises:
        InvalidInputError: no bulk run, or a shard that cannot be read.
    """
    job = Job.read(folder)
    if job is None:
        raise InvalidInputError(f"folder {folder}", "no job.json", "the folder of a bulk run")
    ledger, operation = Ledger(folder), job.choices.operation
    found = totals(ledger, job)
    recalibrated = operation is Operation.RECALIBRATE
    unit = DEVICES if recalibrated else PAGES
    common = _common_folder(job)
    return BulkData(
        title=f"Bulk run {folder.absolute().name}: {operation}",
        told=_told(job, found, unit),
        cards=_cards(found, unit),
        facts=_facts(job, found),
        unit=unit,
        found=found,
        causes=[
            (cause, count, count / found.pages, _meaning(cause, found.examples.get(cause, "").replace(common, "")))
            for cause, count in found.lost.most_common()
        ],
        devices=_devices(found, common),
        fleet=any(source.device for source in job.sources),
        recalibrations=_recalibrations(found, common) if recalibrated else None,
        workers=_workers(found.readings),
        files=_files(folder) if operation is Operation.RECOVER else None,
    )


def begun_s(readings: Sequence[Reading]) -> float:
    """Return the time at which the first range was begun, seconds since 1970."""
    return min(reading.finished_s - reading.seconds for reading in readings)


def _told(job: Job, found: Totals, unit: str) -> str:
    unopened, failed = sum(source.problem is not None for source in job.sources), _failed(found)
    named = f" {counted(unopened, 'recording')} could not be opened." if unopened else ""
    if unit == DEVICES:
        named = f" {counted(failed, 'device')} failed; the next run tries again." if failed else ""
    if found.missing:
        missing = f"{found.missing:,} of {found.pages:,} {unit} have no result yet"
        return f"Not finished: {missing}. The same command goes on with them.{named}"
    lost = found.lost.total()
    end = f"{lost:,} of {found.pages:,} {unit} are {_LOST[unit]}" if lost else f"none is {_LOST[unit]}"
    return f"Finished: {end}.{named}"


def _failed(found: Totals) -> int:
    """Devices that lack something, or have a recording that could not be opened."""
    return sum(row["state"] is DeviceState.FAILED for row in found.devices)


def _cards(found: Totals, unit: str) -> list[tuple[str, str, str]]:
    readings = found.readings
    cards = [
        ("Done", f"{found.pages - found.missing:,}", f"of {found.pages:,} {unit}"),
        (_LOST[unit].capitalize(), f"{found.lost.total():,}", unit),
    ]
    if failed := _failed(found):
        cards.append(("Failed", f"{failed:,}", f"{unit}, not among those"))
    if found.left_out:
        cards.append(("Left out", f"{found.left_out:,}", "pages that a bundle was made from"))
    for measure, name in MEASURES.items():
        if (value := found.figures[measure].value) is not None:
            cards.append((f"{name[0].upper()}{name[1:]}", number(value, 3), "bit/symbol, mean"))
    if readings:
        at_work = sum(end - begin for begin, end in sessions(readings))
        pages, seconds = sum(r.pages for r in readings), sum(r.seconds for r in readings)
        cards.append(("Speed", number(pages / max(at_work, 1e-9), 2), f"{unit}/s while at work"))
        cards.append(("Worker time", number(seconds / max(pages, 1), 3), f"s a {unit[:-1]}"))
    return cards


def _bundle(bundle: NamedBundle) -> str:
    told = f"{bundle.path.name}, {bundle.sha256[:12] or 'could not be read'}"
    return f"{bundle.version} ({told})" if bundle.version else told


def _facts(job: Job, found: Totals) -> list[tuple[str, str]]:
    choices, readings = job.choices, found.readings
    facts = [
        ("Recordings", f"{len(job.sources):,}, of {counted(len(found.groups or found.devices), 'device')}")
        if any(source.device for source in job.sources)
        else ("Recordings", f"{len(job.sources):,}"),
        ("Bundles", _few([_bundle(each) for each in job.bundles])),
        ("Read by", _few([f"{version}: {count:,}" for version, count in found.models.most_common()])),
    ]
    if choices.operation is Operation.RECALIBRATE:
        pages, tuning = choices.device_pages, choices.fine_tuning
        facts.append(("Known pages", "all of each device" if pages is None else f"at most {pages} a device"))
        if tuning is not None:
            facts.append(("Network", f"trained on for {tuning.steps:,} steps at a rate of {tuning.learning_rate:g}"))
    else:
        followed = "the image is followed" if choices.tracking else "the image is not followed"
        facts.append(("Ranges", f"of {counted(choices.range_pages, 'page')}, {followed} within each"))
        facts.append(("Device has changed", f"by the pilots of {found.recalibration_due:,} pages"))
    if found.ece is not None:
        facts.append(("ECE", number(found.ece, 4)))
    if readings:
        begun, end = begun_s(readings), max(reading.finished_s for reading in readings)
        worked = sessions(readings)
        pauses = f", in {len(worked)} parts" if len(worked) > 1 else ""
        at_work = how_long(sum(until - since for since, until in worked))
        facts.append(("Time", f"{_moment(begun)} to {_moment(end)}; at work {at_work}{pauses}"))
        if read := sum(reading.read_bytes for reading in readings):
            facts.append(("Frames read", f"{read / 1e9:,.3g} GB as they lie in the recordings"))
    return facts


def _common_folder(job: Job) -> str:
    """The beginning of all recordings' paths, which need not be told each time; empty where there is none."""
    return os.path.join(os.path.commonpath([source.path.parent for source in job.sources]), "") if job.sources else ""


def _devices(found: Totals, common: str) -> list[Device]:
    """The worst first: by the share of pages lost, then by the first measure that is known."""
    devices = [
        Device(name.removeprefix(common), group, group.told.replace(common, "")) for name, group in found.groups.items()
    ]

    def rank(device: Device) -> tuple[float, float]:
        group = device.group
        known = (group.figures[name].value for name in MEASURES)
        value = next((value for value in known if value is not None), None)
        return -group.lost.total() / max(1, group.pages), float("inf") if value is None else value

    return sorted(devices, key=rank)


def _recalibrations(found: Totals, common: str) -> list[Recalibration]:
    """The worst first: refused ones, those that failed, those yet to come, and then by AIR."""

    def device(row: dict[str, Any]) -> Recalibration:
        made = row["state"] is DeviceState.RECALIBRATED
        return Recalibration(
            name=row["device"] or row["recordings"][0].removeprefix(common),
            recordings=len(row["recordings"]),
            state=row["state"],
            air_before=row.get("air_before"),
            air_after=row.get("air_after"),
            version=row["version"] if made else "",
            reason=row["reason"].replace(common, ""),
        )

    worst = (DeviceState.REFUSED, DeviceState.FAILED, DeviceState.MISSING, DeviceState.RECALIBRATED)
    return sorted(map(device, found.devices), key=lambda each: (worst.index(each.state), each.air_after or 0.0))


def _workers(readings: Sequence[Reading]) -> list[Worker]:
    sums: dict[str, list[float]] = {}
    for reading in readings:
        own = sums.setdefault(reading.worker, [0, 0, 0.0])
        for place, value in enumerate((1, reading.pages, reading.seconds)):
            own[place] += value
    workers = [Worker(name, int(count), int(pages), seconds) for name, (count, pages, seconds) in sums.items()]
    return sorted(workers, key=lambda worker: -worker.pages)


def _files(folder: Path) -> list[File] | None:
    known = known_files(folder)
    return None if known is None else [_file(told) for told in known]


def _file(told: dict[str, Any]) -> File:
    if told["error"] is not None:
        return File(told["volume"], told["file_bytes"], told["error"], whole=False)
    restored = told["restored"]
    mended = f", {counted(len(restored), 'data page')} ({_few(ranges(restored).split(', '))}) of it from parity"
    result = f"whole{mended if restored else ''}: {Path(told['file']).name}"
    return File(told["volume"], told["file_bytes"], result, whole=True)


def sessions(readings: Sequence[Reading], pause_s: float = PAUSE_S) -> list[tuple[float, float]]:
    """Return the times of work, (begin, end), seconds since 1970; shorter pauses do not count."""
    spans = sorted((reading.finished_s - reading.seconds, reading.finished_s) for reading in readings)
    found: list[tuple[float, float]] = []
    for begin, end in spans:
        if found and begin <= found[-1][1] + pause_s:
            found[-1] = found[-1][0], max(found[-1][1], end)
        else:
            found.append((begin, end))
    return found


def _meaning(cause: str, example: str) -> str:
    """A cause for people, and the first page that was lost by it."""
    known = LOSSES[Loss(cause)] if cause in set(Loss) else ""
    return "; ".join(part for part in (known, example) if part)


def _moment(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _few(parts: list[str]) -> str:
    """An enumeration that does not grow without end."""
    more = f" and {len(parts) - _NAMED:,} more" if len(parts) > _NAMED else ""
    return ", ".join(parts[:_NAMED]) + more if parts else "none"
