"""Baselines of a bulk run: the pages that a single process reads, and the speed of bare decode loops."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import h5py
import numpy as np

from analysis.scaling.bulk_run import LIMIT_S, THREADS, records_of
from lightpage.helper_process import same_packages
from lightpage.runtime.archives.run.driver import run
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.shard import SYMBOLS, ShardRecord
from lightpage.runtime.archives.workers.local import LocalEngine


def single(job: Job, folder: Path) -> None:
    """Run a job with one worker; results that are there stay."""
    if Job.read(folder) != job:
        shutil.rmtree(folder, ignore_errors=True)
    with Ledger(folder) as ledger:
        job.write(ledger.folder)
        run(ledger, job, lambda: LocalEngine(1, THREADS))


def compared(job: Job, folder: Path, single_folder: Path) -> dict[str, int]:
    """Pages of a run that are missing, twice, or other than in another run."""
    found: Counter[int] = Counter()
    different = 0
    for path in records_of(folder):
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
    """Return pages a second of two decode loops side by side, each over half of the pages."""
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
