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
import sys
import time
import uuid
from collections import Counter
from pathlib import Path
from typing import Any

import click

from analysis.comparison.kept_bundle import export_kept
from analysis.scaling.archive import archive
from analysis.scaling.bulk_run import LIMIT_S, THREADS, WORKERS, BulkRun, Cluster, nodes_of
from analysis.scaling.processes import Watch
from analysis.scaling.single_process import bare_pages_per_s, compared, single
from analysis.service.running import until
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.question import of_recordings
from lightpage.runtime.archives.run.task import Choices, Operation
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.train.models.presets import FAST

WARM_PAGES = 200
"""After which memory should be flat, unless told otherwise."""

_LOOK_S = 0.05


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
    with nodes_of(engine, mark) as cluster:
        options: tuple[str, ...] = ("--workers", str(WORKERS), "--threads", str(THREADS))
        if cluster is not None:
            options = ("--engine", "ray", "--address", cluster.address, "--threads", str(THREADS))
        figures |= killed(BulkRun(job, out / "killed", options, mark), job, kills, nodes, cluster, seed)
        figures |= compared(job, out / "killed", out / "single")
        if json_path is not None:  # the rest takes as long again
            write_figures(json_path, figures)
        figures |= in_peace(BulkRun(job, out / "peace", options, mark), job, warm_pages)
    click.echo(json.dumps(figures, indent=2))
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.scaling.faults"))
