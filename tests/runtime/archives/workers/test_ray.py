"""Ray: the same results, and a worker or node that dies or hangs costs what it was at. A cluster takes ten seconds."""

import math
import os
import signal
import sys
import uuid
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lightpage.errors import WorkerError
from lightpage.runtime.archives.run.driver import run
from lightpage.runtime.archives.run.engine import ATTEMPTS, longest_s
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.question import of_recordings
from lightpage.runtime.archives.run.task import (
    Choices,
    Done,
    Failed,
    NamedBundle,
    Operation,
    Outcome,
    RecordedFile,
    Stamp,
    Task,
)
from lightpage.runtime.archives.workers import ray_engine
from lightpage.runtime.archives.workers.ray_engine import RayEngine
from lightpage.runtime.archives.workers.work import Worker
from tests.runtime import toy
from tests.runtime.archives.archive import InlineEngine
from tests.runtime.archives.workers.test_local import pages

PAGES, RANGE = 60, 5


READS_S, HANGS_S = 100.0, 5000.0
"""Of a range of one page, which may take 660."""


class FakeRay:
    """What the engine needs of Ray, by a clock that runs while somebody waits.

    So many tasks are at work at once, in the order in which they came. One is ready in time also if it was cancelled.
    """

    exceptions = SimpleNamespace(RayError=RuntimeError)

    def __init__(self, cpus: int, takes: Callable[[Task], float]) -> None:
        self.now, self.cpus, self.takes = 0.0, cpus, takes
        self.tasks: list[Task] = []
        self.ends: dict[int, float] = {}
        self.cancelled: list[int] = []

    def clock(self) -> float:
        return self.now

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": self.cluster_resources()}]

    def cluster_resources(self) -> dict[str, int]:
        return {"CPU": self.cpus}

    def remote(self, work: object) -> Any:
        return SimpleNamespace(options=lambda **_: SimpleNamespace(remote=self._take))

    def _take(self, task: Task, threads: int) -> int:
        self.tasks.append(task)
        return len(self.tasks) - 1

    def wait(self, refs: list[int], num_returns: int, timeout: float) -> tuple[list[int], list[int]]:
        end = self.now + timeout
        while True:
            self._begin()
            ready = [ref for ref in refs if self.ends.get(ref, math.inf) <= self.now]
            following = min((at for at in self.ends.values() if at > self.now), default=math.inf)
            if ready or following > end:
                self.now = self.now if ready else end
                return ready[:num_returns], []
            self.now = following

    def _begin(self) -> None:
        waiting = [ref for ref in range(len(self.tasks)) if ref not in self.ends and ref not in self.cancelled]
        at_work = [ref for ref, end in self.ends.items() if end > self.now and ref not in self.cancelled]
        for ref in waiting[: max(0, self.cpus - len(at_work))]:
            self.ends[ref] = self.now + self.takes(self.tasks[ref])

    def get(self, ref: int) -> Outcome:
        return Done(task=self.tasks[ref], lost={}, seconds=1.0)

    def cancel(self, ref: int, *, force: bool) -> None:
        assert force  # or its worker goes on
        self.cancelled.append(ref)


def a_range(page: int) -> Task:
    return Task(
        choices=Choices(operation=Operation.DECODE),
        files=(RecordedFile(path=Path("a.h5"), stamp=Stamp(size=1, modified_ns=1)),),
        pages=(page,),
        bundle=NamedBundle(path=Path("b.zip"), sha256="", version=""),
        shard=Path(f"{page}"),
    )


class Hanging:
    """Seconds that ranges take: the first so many tries of some of them hang."""

    def __init__(self, hangs: dict[int, int]) -> None:
        self.hangs, self.tries = hangs, Counter[int]()

    def __call__(self, task: Task) -> float:
        (page,) = task.pages
        self.tries[page] += 1
        return HANGS_S if self.tries[page] <= self.hangs.get(page, 0) else READS_S


def outcomes_by(ray: FakeRay, ranges: int, monkeypatch: pytest.MonkeyPatch) -> tuple[RayEngine, list[Outcome]]:
    monkeypatch.setattr(ray_engine, "connected", lambda address: nullcontext(ray))
    engine = RayEngine(threads=1, clock=ray.clock)
    return engine, list(engine.run(map(a_range, range(ranges))))


def test_a_worker_that_hangs_is_killed_and_its_range_is_read_by_another(monkeypatch: pytest.MonkeyPatch) -> None:
    ray = FakeRay(2, takes := Hanging({1: 1}))
    engine, outcomes = outcomes_by(ray, 100, monkeypatch)
    assert {type(outcome) for outcome in outcomes} == {Done}
    read = [outcome.task.pages[0] for outcome in outcomes]
    assert sorted(read) == list(range(100))  # none twice, though the worker that was killed answers after that
    assert takes.tries == Counter(read) + Counter({1: 1})
    assert read.index(1) * READS_S < 2 * longest_s(a_range(1))  # it is not left for the end
    assert (engine.restarts, ray.cancelled, engine.in_flight) == (1, [1], 0)


def test_a_range_at_which_all_workers_hang_is_given_up_and_those_that_wait_for_a_worker_are_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ray = FakeRay(1, takes := Hanging({0: ATTEMPTS}))
    engine, outcomes = outcomes_by(ray, 3, monkeypatch)
    assert takes.tries == {0: ATTEMPTS, 1: 1, 2: 1}
    assert engine.restarts == ATTEMPTS
    (failed,) = [outcome for outcome in outcomes if isinstance(outcome, Failed)]
    assert (failed.problem.subject, failed.problem.got) == ("recording a.h5: pages 0-0", "no answer in time")
    assert sorted(outcome.task.pages[0] for outcome in outcomes) == [0, 1, 2]


def test_a_cluster_without_any_workers_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(task: Task) -> float:
        ray.cpus = 0
        return math.inf

    ray = FakeRay(1, lost)
    with pytest.raises(WorkerError, match="the Ray cluster"):
        outcomes_by(ray, 3, monkeypatch)
    assert ray.now <= longest_s(a_range(0))
    assert sorted(ray.cancelled) == [0, 1]  # nothing is left behind


@pytest.mark.long  # a cluster takes ten seconds to start; what its engine does is shown without one
def test_a_worker_and_a_node_die_and_nothing_is_missing_twice_or_different(
    toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ray.cluster_utils import Cluster

    mark = uuid.uuid4().hex
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("LIGHTPAGE_MARK", mark)
    toy.write_toy_recording(tmp_path / "a.h5", toy.ToyDevice(seed=1), 16, PAGES)
    choices = Choices(operation=Operation.EVALUATE, range_pages=RANGE)
    job = of_recordings(choices, [str(tmp_path / "a.h5")], str(toy_zip), None)
    with Ledger(tmp_path / "single") as ledger:
        run(ledger, job, lambda: InlineEngine(Worker(1)))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        node = cluster.add_node(num_cpus=1)
        engine = RayEngine(cluster.address, threads=1)
        with Ledger(tmp_path / "killed") as ledger:
            done, worker = [], None
            for outcome in engine.run(ledger.missing(job)):
                assert isinstance(outcome, Done)
                done.append(outcome.task.pages)
                if len(done) == 2:
                    cluster.remove_node(node, allow_graceful=False)
                    cluster.add_node(num_cpus=1)
                if len(done) >= 4 and worker is None and (at_work := working(mark)):  # ranges are short
                    worker = at_work[0]
                    os.kill(worker, signal.SIGKILL)
        assert sorted(done) == [tuple(range(first, first + RANGE)) for first in range(0, PAGES, RANGE)]
        assert pages(tmp_path / "killed") == pages(tmp_path / "single")
        assert worker is not None
        assert engine.restarts >= 1
    finally:
        cluster.shutdown()


def working(mark: str) -> list[int]:
    """Processes that Ray works with, of the cluster with this mark in its environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            name, environment = ((folder / part).read_bytes() for part in ("cmdline", "environ"))
        except OSError:
            continue
        if b"ray::_work" in name and mark.encode() in environment:
            found.append(int(folder.name))
    return found


def test_a_cluster_of_this_machine_is_started_whatever_the_surroundings_say(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    settings: dict[str, Any] = {}
    ray = SimpleNamespace(is_initialized=bool, init=lambda **told: settings.update(told), shutdown=lambda: None)
    monkeypatch.setitem(sys.modules, "ray", ray)
    with ray_engine.connected(None):
        assert settings["address"] == "local"
        folder = Path(settings["_temp_dir"])
        assert folder.is_dir()
    assert not folder.exists()
    with ray_engine.connected("auto"):
        assert settings["address"] == "auto"
