"""Measures what one node takes, measured on this machine: for a page, for a range, and of the driver."""

from __future__ import annotations

import itertools
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from analysis.scaling.idle_worker import nothing
from lightpage.errors import InvalidInputError
from lightpage.helper_process import same_packages
from lightpage.metrics.provenance import Provenance, provenance
from lightpage.runtime.archives.run.engine import Engine
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.shard import ShardRecord
from lightpage.runtime.archives.run.task import Choices, NamedBundle, Operation, RecordedFile, Stamp, Task
from lightpage.runtime.archives.run.totals import totals
from lightpage.runtime.archives.workers.local import LocalEngine, started
from lightpage.runtime.archives.workers.ray_engine import RayEngine, connected
from lightpage.runtime.model.bundle.shipped import DEFAULT
from lightpage.runtime.model.execution.cpus import available_cpus

IN_FLIGHT = (2, 64, 512, 2048)
"""Ranges on their way at once, at which the driver of a cluster is measured."""
IDLE_WORKER = "analysis.scaling.idle_worker:IdleWorker"
_LIMIT_S = 6 * 3600.0
_WARM, _COUNTED = 100, 400
"""Outcomes before the driver's time is counted, and while it is."""
_RECORDS = 30
_Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Part(BaseModel):
    """Figures in JSON."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class RunFigures(Part):
    """A bulk run with so many workers.

    Attributes:
        workers: processes of one thread.
        page_seconds: mean seconds of a page, for each range.
        pages_per_s: rate from the first range's beginning to the last one's end.
    """

    workers: int
    page_seconds: Annotated[tuple[_Seconds, ...], Field(min_length=1)]
    pages_per_s: Annotated[float, Field(gt=0)]


class DriverFigures(Part):
    """Measure what the driver takes for a range, handing it out and taking what comes back.

    Attributes:
        in_flight: ranges on their way at once.
        cpu_s: seconds of its process, all threads together.
        main_thread_s: seconds of its loop alone.
        wall_s: between two outcomes; workers that do nothing share the machine with it.
    """

    in_flight: int
    cpu_s: _Seconds
    main_thread_s: _Seconds
    wall_s: _Seconds


class NodeFigures(Part):
    """Figures of a node that the model of a cluster is made from.

    Attributes:
        provenance: where they are from.
        cores: cores of the machine.
        range_pages, pages: numbers of pages of a range, and of a run.
        measured: runs that the model is made from, by their workers.
        checked: runs of the same pages, made after these, that it is compared with.
        read_bytes: bytes of a page in the recording.
        written_bytes: bytes of a page's result: symbols, confidences, and its part of the record.
        record_s: median seconds to write a record, until it is on the disk.
        local, ray: the driver of either engine.
    """

    provenance: Provenance = Provenance()
    cores: int
    range_pages: int
    pages: int
    measured: tuple[RunFigures, ...]
    checked: tuple[RunFigures, ...]
    read_bytes: Annotated[float, Field(gt=0)]
    written_bytes: Annotated[float, Field(gt=0)]
    record_s: _Seconds
    local: tuple[DriverFigures, ...]
    ray: tuple[DriverFigures, ...]

    @classmethod
    def read(cls, path: Path) -> NodeFigures:
        """Read the figures of a file.

        Raises:
            InvalidInputError: it does not hold them.
        """
        try:
            return cls.model_validate_json(path.read_bytes())
        except (OSError, ValidationError) as error:
            raise InvalidInputError(f"figures {path}", error, "what --keep has written") from None


def measure(recording: Path, folder: Path, range_pages: int, worker_counts: tuple[int, ...] = (1, 2)) -> NodeFigures:
    """Run it all; a few minutes for a hundred pages.

    Args:
        recording: recording that is read.
        folder: folder that runs go into.
        range_pages: number of pages of a range.
        worker_counts: how many work in each run.
    """
    runs = [
        [_run(recording, folder / f"{name}-{workers}", range_pages, workers) for workers in worker_counts]
        for name in ("measured", "checked")
    ]
    first = folder / f"measured-{worker_counts[0]}"
    job = Job.read(first)
    assert job is not None  # a run has just written it
    found = totals(Ledger(first), job)
    shards = sum(path.stat().st_size for path in first.glob("shards/*/*"))
    like = ShardRecord.read(next(iter(sorted(first.glob("shards/*/*.json")))).with_suffix(""))
    with connected(None):
        ray = tuple(_driver(RayEngine(None, in_flight, 1, nothing), in_flight) for in_flight in IN_FLIGHT)
    return NodeFigures(
        provenance=provenance(recording=recording),
        cores=available_cpus(),
        range_pages=range_pages,
        pages=found.pages,
        measured=tuple(runs[0]),
        checked=tuple(runs[1]),
        read_bytes=sum(reading.read_bytes for reading in found.readings) / found.pages,
        written_bytes=shards / found.pages,
        record_s=_record_s(like, folder),
        local=tuple(
            _driver(LocalEngine(workers, 1, partial(started, target=IDLE_WORKER)), workers) for workers in worker_counts
        ),
        ray=ray,
    )


def _run(recording: Path, folder: Path, range_pages: int, workers: int) -> RunFigures:
    shutil.rmtree(folder, ignore_errors=True)
    command = [sys.executable, "-m", "lightpage.cli.main", "bulk", "decode", str(folder)]
    asked = ["--recordings", str(recording), "--bundle", DEFAULT, "--range-pages", str(range_pages)]
    options = ["--workers", str(workers), "--threads", "1"]
    subprocess.run(
        [*command, *asked, *options], env=same_packages(1), stdout=subprocess.DEVNULL, check=True, timeout=_LIMIT_S
    )
    job = Job.read(folder)
    assert job is not None  # the command has written it
    readings = totals(Ledger(folder), job).readings
    begun = min(reading.finished_s - reading.seconds for reading in readings)
    pages = sum(reading.pages for reading in readings)
    return RunFigures(
        workers=workers,
        page_seconds=tuple(reading.seconds / reading.pages for reading in readings),
        pages_per_s=pages / (max(reading.finished_s for reading in readings) - begun),
    )


def _record_s(like: ShardRecord, folder: Path) -> float:
    took = []
    with tempfile.TemporaryDirectory(dir=folder) as there:
        for number in range(_RECORDS):
            begun = time.perf_counter()
            like.write(Path(there) / f"{number:08d}")
            took.append(time.perf_counter() - begun)
    return statistics.median(took)


def _driver(engine: Engine, in_flight: int) -> DriverFigures:
    outcomes = engine.run(_tasks())
    try:
        for _ in range(_WARM):
            next(outcomes)
        before = time.process_time(), time.thread_time(), time.perf_counter()
        for _ in range(_COUNTED):
            next(outcomes)
        after = time.process_time(), time.thread_time(), time.perf_counter()
    finally:
        outcomes.close()
    cpu, main, wall = ((late - early) / _COUNTED for early, late in zip(before, after, strict=True))
    return DriverFigures(in_flight=in_flight, cpu_s=cpu, main_thread_s=main, wall_s=wall)


def _tasks() -> Iterator[Task]:
    """Yield tasks without end, as long as real ones."""
    recording = Path("/archive/shelf-1/recording-000001.h5")
    task = Task(
        choices=Choices(operation=Operation.DECODE),
        files=(RecordedFile(path=recording, stamp=Stamp(size=1 << 33, modified_ns=1 << 60)),),
        pages=tuple(range(32)),
        bundle=NamedBundle(path=Path("/archive/bundle.zip"), sha256="0" * 64, version="1"),
        shard=Path("/archive/run/shards/000000/00000000"),
    )
    for number in itertools.count():
        yield task.model_copy(update={"shard": task.shard.with_name(f"{number:08d}")})
