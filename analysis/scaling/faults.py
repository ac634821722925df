"""A bulk run whose workers and nodes are killed: is a page missing, twice, or other than in a single process's run?

    python -m analysis.scaling.faults --engine local --pages 5000 --fields 300 --kills 20 --out FOLDER --json FILE
    python -m analysis.scaling.faults --engine ray --pages 5000 --fields 300 --kills 20 --nodes 3 --out FOLDER
    python -m analysis.scaling.faults --kept analysis/weights/bench/-0.6deg-32e-4px --out FOLDER

The last one reads with the quick decoder of a kept data set, which takes a sixth of the time.

An archive of bench pages is read in this process, then with two workers that are killed by SIGKILL in a seeded order,
then with two workers in peace beside two bare decode loops, and compared. With Ray there are two nodes on this machine,
of which one is killed and added again. What this process reads is kept, and goes for the other engine too.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import click
import h5py
import numpy as np

from analysis.comparison.kept_bundle import export_kept
from analysis.scaling.archive import archive
from analysis.scaling.processes import Watch, children, with_mark
from analysis.service.running import until
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.files import write_json
from lightpage.helper_process import same_packages
from lightpage.runtime.archives.run.driver import run
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.question import of_recordings
from lightpage.runtime.archives.run.shard import RECORD, SYMBOLS, ShardRecord
from lightpage.runtime.archives.run.task import Choices, Operation
from lightpage.runtime.archives.workers.local import LocalEngine
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.train.models.presets import FAST

WORKERS, THREADS = 2, 1
WARM_PAGES = 200
"""After which memory should be flat, unless told otherwise."""

MARK = "LIGHTPAGE_BENCH_MARK"
LIMIT_S = 6 * 3600.0
_LOOK_S = 0.05
_BULK = (sys.executable, "-m", "lightpage.cli.main", "bulk")


class Cluster:
    """Two Ray nodes of one worker each on this machine."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster as Nodes  # it takes a second, and is wanted with Ray alone

        head = {"num_cpus": THREADS, "include_dashboard": False}
        self._nodes = Nodes(initialize_head=True, head_node_args=head)
        self._second = self._nodes.add_node(num_cpus=THREADS)
        self.address: str = self._nodes.address

    def lose_a_node(self) -> None:
        """Kill the second node with all that runs on it, and add another."""
        self._nodes.remove_node(self._second, allow_graceful=False)
        self._second = self._nodes.add_node(num_cpus=THREADS)

    def close(self) -> None:
        """End both."""
        self._nodes.shutdown()  # type: ignore[no-untyped-call]


class BulkRun:
    """`lightpage bulk decode` in a process of its own; it runs in a `with` statement.

    Args:
        job: what it is asked.
        folder: of the run.
        options: beside what is asked.
        mark: in the environment of its workers.
    """

    def __init__(self, job: Job, folder: Path, options: tuple[str, ...], mark: str) -> None:
        self.folder, self._mark, self._json = folder, mark, folder.with_suffix(".json")
        asked = ["--recordings", str(job.sources[0].path), "--bundle", str(job.bundles[0].path)]
        asked += ["--range-pages", str(job.choices.range_pages), "--json", str(self._json)]
        self._command = [*_BULK, "decode", str(folder), *asked, *options]

    def __enter__(self) -> Self:
        environment = {**same_packages(THREADS), MARK: self._mark, "RAY_USAGE_STATS_ENABLED": "0"}
        self.process = subprocess.Popen(self._command, env=environment, stdout=subprocess.DEVNULL)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def wait(self) -> dict[str, Any]:
        """Wait for its end and return its figures.

        Raises:
            RuntimeError: it failed.
        """
        if status := self.process.wait(LIMIT_S):
            raise RuntimeError(f"the bulk run ended with status {status}")
        found: dict[str, Any] = json.loads(self._json.read_text())
        return found

    def shards(self) -> int:
        """Ranges that are done."""
        return sum(1 for _ in self.folder.glob(f"shards/*/*{RECORD}"))

    def workers(self) -> list[int]:
        """Its workers' processes."""
        return children(self.process.pid) or with_mark(b"ray::_work", self._mark)

    def pages_per_s(self, pages: int) -> float:
        """From the first range's beginning to the last one's end."""
        found = [(path.stat().st_mtime, ShardRecord.read(path.with_suffix(""))) for path in _records(self.folder)]
        begun = min(end - record.seconds for end, record in found)
        return pages / (max(end for end, _ in found) - begun)


def _records(folder: Path) -> Iterator[Path]:
    return folder.glob(f"shards/*/*{RECORD}")


def single(job: Job, folder: Path) -> None:
    """What one worker reads; what is there of it already stays."""
    if Job.read(folder) != job:
        shutil.rmtree(folder, ignore_errors=True)
    with Ledger(folder) as ledger:
        job.write(ledger.folder)
        run(ledger, job, lambda: LocalEngine(1, THREADS))


def killed(bulk: BulkRun, job: Job, kills: int, nodes: int, cluster: Cluster | None, seed: int) -> dict[str, Any]:
    """Run it, kill workers and nodes after a seeded number of ranges, and say what came of it."""
    chance = random.Random(seed)
    ranges = -(-job.sources[0].pages // job.choices.range_pages)
    moments = sorted(
        [(chance.randrange(1, max(2, ranges - 2)), "worker") for _ in range(kills)]
        + [(chance.randrange(1, max(2, ranges - 2)), "node") for _ in range(nodes if cluster is not None else 0)]
    )
    done = Counter[str]()
    with bulk:
        for moment, kind in moments:
            for _ in until(time.monotonic() + LIMIT_S, _LOOK_S):
                if bulk.process.poll() is not None or (bulk.shards() >= moment and bulk.workers()):
                    break
            time.sleep(chance.random() * 0.5)
            if kind == "node" and cluster is not None:
                cluster.lose_a_node()
                done[kind] += 1
            elif workers := bulk.workers():
                os.kill(chance.choice(workers), 9)
                done[kind] += 1
        figures = bulk.wait()
    return {
        "kills": done["worker"],
        "nodes_lost": done["node"],
        "ranges": ranges,
        "ranges_given_out_again": figures["this_run"]["worker_restarts"],
    }


def compared(job: Job, folder: Path, single_folder: Path) -> dict[str, int]:
    """Pages of a run that are missing, twice, or other than in another run."""
    found: Counter[int] = Counter()
    different = 0
    for path in _records(folder):
        own, other = (ShardRecord.read(each.with_suffix("")) for each in (path, _same(path, folder, single_folder)))
        found.update(page.page for page in own.pages)
        different += sum(a != b for a, b in zip(own.pages, other.pages, strict=True))
        symbols = path.with_suffix(SYMBOLS)
        with h5py.File(str(symbols)) as a, h5py.File(str(_same(symbols, folder, single_folder))) as b:
            for name in ("pages", "symbols", "confidence"):
                different += name in a and not np.array_equal(a[name][()], b[name][()])
    return {
        "missing": job.sources[0].pages - len(found),
        "twice": sum(count > 1 for count in found.values()),
        "different": different,
    }


def _same(path: Path, folder: Path, other: Path) -> Path:
    return other / path.relative_to(folder)


def bare_pages_per_s(job: Job) -> float:
    """Of two decode loops beside each other, each over its half of the pages."""
    source, pages = job.sources[0], job.sources[0].pages
    parts = [(0, pages // 2), (pages // 2, pages)]
    command = [sys.executable, "-m", "analysis.scaling.bare_loop", str(source.path), str(job.bundles[0].path)]
    loops = [
        subprocess.Popen(
            [*command, str(first), str(end), str(THREADS)],
            env=same_packages(THREADS),
            stdout=subprocess.PIPE,
            text=True,
        )
        for first, end in parts
    ]
    seconds = [float(loop.communicate(timeout=LIMIT_S)[0]) for loop in loops]
    return sum((end - first) / took for (first, end), took in zip(parts, seconds, strict=True))


def in_peace(bulk: BulkRun, job: Job, warm_pages: int) -> dict[str, Any]:
    """Speed against bare loops, and growth of memory after so many pages."""
    bare = [bare_pages_per_s(job)]
    step = job.choices.range_pages
    with (
        bulk,
        Watch(lambda: {"driver": [bulk.process.pid], "worker": bulk.workers()}, lambda: step * bulk.shards()) as watch,
    ):
        bulk.wait()
    bare.append(bare_pages_per_s(job))  # before and after: other work on the machine comes and goes
    speed = bulk.pages_per_s(job.sources[0].pages)
    mean = sum(bare) / len(bare)
    return {
        "pages_per_s": speed,
        "bare_pages_per_s": bare,
        "share_of_bare": speed / mean,
        "memory_growth": watch.growth(warm_pages),
        "memory_growth_after_pages": warm_pages,
    }


@contextmanager
def _nodes(engine: str, mark: str) -> Iterator[Cluster | None]:
    if engine == "local":
        yield None
        return
    os.environ |= {MARK: mark, "RAY_USAGE_STATS_ENABLED": "0", **same_packages(THREADS)}
    cluster = Cluster()
    try:
        yield cluster
    finally:
        cluster.close()


@click.command()
@click.option("--engine", type=click.Choice(["local", "ray"]), default="local", show_default=True)
@click.option("--pages", default=5000, show_default=True, type=click.IntRange(4))
@click.option("--fields", default=300, show_default=True, type=click.IntRange(1), help="Pages that are simulated.")
@click.option("--range-pages", default=32, show_default=True, type=click.IntRange(1))
@click.option("--kills", default=20, show_default=True, type=click.IntRange(0), help="SIGKILLs of workers.")
@click.option("--nodes", default=3, show_default=True, type=click.IntRange(0), help="Nodes that are lost, with Ray.")
@click.option("--warm-pages", default=WARM_PAGES, show_default=True, type=click.IntRange(0), help="Memory may grow.")
@click.option(
    "--kept",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder of a data set in analysis/weights whose quick decoder reads; the shipped bundle by default.",
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--out", required=True, type=OutputFolder(), help="Archive and runs; the archive is kept.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    engine: str,
    pages: int,
    fields: int,
    range_pages: int,
    kills: int,
    nodes: int,
    warm_pages: int,
    kept: Path | None,
    seed: int,
    out: Path,
    json_path: Path | None,
) -> None:
    """Print what was missing, twice or different, what was done again and how fast it was."""
    out.mkdir(parents=True, exist_ok=True)
    recording = archive(out, pages, fields, seed, kept)
    bundle = bundle_path(DEFAULT)
    if kept is not None and not (bundle := out / "fast.zip").exists():
        export_kept(kept, out / "kept", bundle, FAST, 0)
    choices = Choices(operation=Operation.DECODE, range_pages=range_pages)
    job = of_recordings(choices, [str(recording)], str(bundle), None)
    for name in ("killed", "peace"):
        shutil.rmtree(out / name, ignore_errors=True)
    single(job, out / "single")
    mark = uuid.uuid4().hex
    figures: dict[str, Any] = {"engine": engine, "pages": pages, "range_pages": range_pages}
    with _nodes(engine, mark) as cluster:
        options: tuple[str, ...] = ("--workers", str(WORKERS), "--threads", str(THREADS))
        if cluster is not None:
            options = ("--engine", "ray", "--address", cluster.address, "--threads", str(THREADS))
        made: Callable[[str], BulkRun] = partial(_run, job, out, options, mark)
        figures |= killed(made("killed"), job, kills, nodes, cluster, seed)
        figures |= compared(job, out / "killed", out / "single")
        if json_path is not None:  # the rest takes as long again
            write_json(json_path, figures)
        figures |= in_peace(made("peace"), job, warm_pages)
    click.echo(json.dumps(figures, indent=2))
    if json_path is not None:
        write_json(json_path, figures)


def _run(job: Job, out: Path, options: tuple[str, ...], mark: str, name: str) -> BulkRun:
    return BulkRun(job, out / name, options, mark)


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.scaling.faults"))
