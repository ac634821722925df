"""`lightpage bulk decode` in a process of its own, on this machine alone or on two Ray nodes of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from analysis.scaling.processes import children, with_mark
from lightpage.helper_process import same_packages
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.shard import RECORD, ShardRecord

WORKERS, THREADS = 2, 1
MARK = "LIGHTPAGE_BENCH_MARK"
LIMIT_S = 6 * 3600.0
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


@contextmanager
def nodes_of(engine: str, mark: str) -> Iterator[Cluster | None]:
    """Ray nodes for that engine, ended behind it; None where it needs none."""
    if engine == "local":
        yield None
        return
    os.environ |= {MARK: mark, "RAY_USAGE_STATS_ENABLED": "0", **same_packages(THREADS)}
    cluster = Cluster()
    try:
        yield cluster
    finally:
        cluster.close()


class BulkRun:
    """`lightpage bulk decode` in a process of its own; it runs in a `with` statement.

    Args:
        job: job of the run.
        folder: folder of the run.
        options: beside what is asked.
        mark: mark in the environment of its workers.
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
        return sum(1 for _ in records_of(self.folder))

    def workers(self) -> list[int]:
        """Process numbers of the run's workers."""
        return children(self.process.pid) or with_mark(b"ray::_work", self._mark)

    def pages_per_s(self, pages: int) -> float:
        """Return pages a second between the beginning of the first range and the end of the last."""
        found = [(path.stat().st_mtime, ShardRecord.read(path.with_suffix(""))) for path in records_of(self.folder)]
        begun = min(end - record.seconds for end, record in found)
        return pages / (max(end for end, _ in found) - begun)


def records_of(folder: Path) -> Iterator[Path]:
    """Records of the ranges that a run has done."""
    return folder.glob(f"shards/*/*{RECORD}")
