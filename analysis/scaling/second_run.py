"""Cost of a second run over finished work: `python -m analysis.scaling.second_run --out FOLDER`.

One recording of simulated pages that hold a file is read for real, by each operation. The archive is that recording
under many names, by hard links, and its run has a copy of the real shards for each of them. So the second run finds
what it would find after a long first one. All files have been read shortly before: a cold disk takes longer.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import click

from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.helper_process import same_packages
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.question import of_recordings
from lightpage.runtime.archives.run.shard import record_of
from lightpage.runtime.archives.run.task import RANGE_PAGES, Choices, Operation
from lightpage.runtime.archives.run.volumes import FOLDER
from lightpage.runtime.model.bundle.shipped import DEFAULT

WANTED_S = 2.0
OPERATIONS = (Operation.DECODE, Operation.EVALUATE, Operation.RECOVER)
_FILE_BYTES = 60_000
_LIMIT_S = 3600.0
_COMMAND = (sys.executable, "-m", "lightpage.cli.main")


def coded_recording(folder: Path, seed: int) -> Path:
    """A recording of the shipped bundle's device whose pages hold a file; made once."""
    out = folder / "coded.h5"
    if not out.exists():
        content, pages = folder / "content", folder / "pages.h5"
        content.write_bytes(random.Random(seed).randbytes(_FILE_BYTES))
        _lightpage("encode", str(content), "--bundle", DEFAULT, "--out", str(pages))
        shown = ("--profile", DEFAULT, "--symbols", str(pages), "--seed", str(seed))
        _lightpage("simulate", *shown, "--out", str(out))
    return out


def finished(folder: Path, recording: Path, operation: Operation, pages: int, range_pages: int) -> int:
    """Make a finished run over links to a recording that is read once; its folder is `folder / "run"`.

    Args:
        folder: folder that links and run go into; it must not be there.
        recording: recording that is read.
        operation: operation that reads it.
        pages: least number of pages of the run.
        range_pages: number of pages of a range.

    Returns:
        How many recordings the run has.
    """
    real = folder / "real"
    folder.mkdir(parents=True)
    asked = ("--recordings", str(recording), "--bundle", DEFAULT, "--range-pages", str(range_pages))
    _lightpage("bulk", str(operation), str(real), *asked, "--workers", "1")
    first = Job.read(real)
    assert first is not None  # the command has written it
    count = -(-pages // first.sources[0].pages)
    for number in range(count):
        os.link(recording, folder / f"{number:05d}.h5")
    choices = Choices(operation=operation, range_pages=range_pages)
    job = of_recordings(choices, [str(folder / "*.h5")], DEFAULT, None)
    with Ledger(folder / "run") as ledger, Ledger(real) as read:
        job.write(ledger.folder)
        for task in ledger.missing(job):
            there = read.shard(0, task.pages[0])
            for file in sorted(there.parent.glob(f"{there.name}.*"), key=record_of(there).__eq__):  # the record last
                shutil.copyfile(file, task.shard.with_name(file.name))
    if (files := real / FOLDER).exists():
        shutil.copytree(files, folder / "run" / FOLDER)
    return count


def second_run(folder: Path, operation: Operation, repeats: int) -> dict[str, Any]:
    """Time runs over finished work, and return the seconds with the pages that they found."""
    out, took, cpu = folder / "second.json", list[float](), list[float]()
    figures: dict[str, Any] = {}
    for _ in range(repeats):
        begun, before = time.perf_counter(), _cpu_s()
        _lightpage("bulk", str(operation), str(folder / "run"), "--json", str(out))
        took.append(time.perf_counter() - begun)
        cpu.append(_cpu_s() - before)
        figures = json.loads(out.read_text())
    return {
        "pages": figures["pages_read"],
        "pages_decoded": figures["this_run"]["pages"],
        "seconds": statistics.median(took),
        "seconds_most": max(took),
        "cpu_seconds": statistics.median(cpu),
    }


def _cpu_s() -> float:
    """Return the CPU seconds of all child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _lightpage(*words: str) -> None:
    done = subprocess.run(
        [*_COMMAND, *words], env=same_packages(1), capture_output=True, text=True, timeout=_LIMIT_S, check=False
    )
    if done.returncode:
        raise RuntimeError(f"lightpage {words[0]} ended with status {done.returncode}: {done.stderr.strip()}")


@click.command()
@click.option("--pages", default=10_000, show_default=True, type=click.IntRange(1))
@click.option("--range-pages", default=RANGE_PAGES, show_default=True, type=click.IntRange(1))
@click.option("--repeats", default=5, show_default=True, type=click.IntRange(1))
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--out", required=True, type=OutputFolder(), help="Recording and runs; the recording is kept.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(pages: int, range_pages: int, repeats: int, seed: int, out: Path, json_path: Path | None) -> None:
    """Print how long a second run takes, Python's start included, and that it decodes nothing."""
    out.mkdir(parents=True, exist_ok=True)
    recording = coded_recording(out, seed)
    titles = f"{'recordings':>10} {'pages':>7} {'decoded':>8} {'s, median':>10} {'s, most':>8} {'CPU s':>6}"
    click.echo(f"{'operation':<10} {titles}")
    figures: dict[str, Any] = {"wanted_s": WANTED_S, "range_pages": range_pages, "operations": {}}
    for operation in OPERATIONS:
        folder = out / f"finished-{operation}"
        shutil.rmtree(folder, ignore_errors=True)
        recordings = finished(folder, recording, operation, pages, range_pages)
        found = second_run(folder, operation, repeats)
        figures["operations"][str(operation)] = {"recordings": recordings, **found}
        click.echo(
            f"{operation:<10} {recordings:>10} {found['pages']:>7} {found['pages_decoded']:>8}"
            f" {found['seconds']:>10.2f} {found['seconds_most']:>8.2f} {found['cpu_seconds']:>6.2f}"
        )
    worst = max(found["seconds_most"] for found in figures["operations"].values())
    click.echo(f"slowest {worst:.2f} s; at most {WANTED_S:g} s wanted for 10,000 pages")
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.scaling.second_run"))
