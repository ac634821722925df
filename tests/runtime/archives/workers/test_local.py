"""Workers that are processes: what one that dies, hangs or talks costs, and that none outlives its driver."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path

import pytest

from lightpage.cli.main import run as run_command
from lightpage.errors import WorkerError
from lightpage.progress import reporting
from lightpage.runtime.archives.run.driver import run
from lightpage.runtime.archives.run.engine import ATTEMPTS, longest_s
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.metrics import BulkMetrics
from lightpage.runtime.archives.run.question import of_recordings
from lightpage.runtime.archives.run.shard import PageRecord, ShardRecord
from lightpage.runtime.archives.run.task import Choices, Done, Failed, Operation, Outcome, Step, Task
from lightpage.runtime.archives.workers.local import LocalEngine, started
from lightpage.runtime.archives.workers.work import Worker
from lightpage.runtime.commands.archives.bulk import bulk
from tests.processes import runs
from tests.runtime import toy
from tests.runtime.archives import jobs
from tests.runtime.archives.archive import InlineEngine
from tests.runtime.archives.workers.deadly_worker import BEGUN, KILLS
from tests.told import Told
from tests.waiting import eventually

ROOT = Path(__file__).resolve().parents[4]
WORKER = "tests.runtime.archives.workers.deadly_worker:DeadlyWorker"
PAGES, RANGE = 12, 3
LIMIT_S = 60


class Workers:
    """Workers that are no processes: at first pages of ranges, so many `hang`, or `die` by signal 9."""

    def __init__(self, hang: dict[int, int] | None = None, die: dict[int, int] | None = None) -> None:
        self.hang, self.die = hang or {}, die or {}
        self.started: list[int] = []
        self.ended: list[float] = []
        self.tries: list[int] = []

    def start(self, threads: int) -> Link:
        self.started.append(threads)
        return Link(self)


class Link:
    """A worker that answers at once, or never."""

    def __init__(self, workers: Workers) -> None:
        self._workers = workers

    def ask(self, method: str, task: Task, threads: int, timeout_s: float, progress: Callable[[Step], None]) -> Outcome:
        all_of, first = self._workers, task.pages[0]
        all_of.tries.append(first)
        assert (method, threads, timeout_s) == ("work", all_of.started[-1], longest_s(task))
        for counts, got in ((all_of.die, "its end"), (all_of.hang, "no answer")):
            if counts.get(first, 0) > 0:
                counts[first] -= 1
                raise WorkerError("a worker", got, "an answer")
        for step in range(2):
            progress(Step(device="a", what=f"{first}, {step}"))
        return Done(task=task, lost={}, seconds=1)

    def end(self, grace_s: float = 0.0) -> None:
        self._workers.ended.append(grace_s)


def outcomes(workers: Workers, tasks: Iterable[Task]) -> tuple[LocalEngine, list[Outcome], Told]:
    engine = LocalEngine(1, 2, workers.start)
    told = Told()
    with reporting(told):
        return engine, list(engine.run(tasks)), told


@pytest.fixture
def ranges(tmp_path: Path) -> list[Task]:
    return list(Ledger(tmp_path).missing(jobs.job(jobs.source("a"))))


def test_workers_do_each_range_once_and_tell_of_it_in_lines_that_may_come_together(ranges: list[Task]) -> None:
    workers = Workers()
    engine, found, told = outcomes(workers, ranges)
    assert [outcome.task.pages for outcome in found] == [(0, 1, 2), (3, 4, 5), (6,)]
    assert told.notes == [f"device a: {first}, {number}" for first in (0, 3, 6) for number in range(2)]
    assert (workers.started, workers.ended) == ([2], [0.0])
    assert (engine.restarts, engine.in_flight, engine.workers_alive) == (0, 0, 0)
    engine = LocalEngine(2, 1, (workers := Workers()).start)
    seen = [(engine.in_flight, engine.workers_alive) for _ in engine.run(ranges)]
    assert (seen, len(workers.started)) == ([(1, 2), (1, 2), (0, 2)], 2)


@pytest.mark.parametrize("kind", ["hang", "die"])
def test_a_range_goes_to_another_worker_and_is_given_up_when_three_have_died_at_it(
    kind: str, ranges: list[Task]
) -> None:
    workers = Workers(**{kind: {0: 1, 3: ATTEMPTS}})
    engine, found, _ = outcomes(workers, ranges)
    assert sorted(workers.tries) == [0] * 2 + [3] * ATTEMPTS + [6]
    (lost,) = [outcome for outcome in found if isinstance(outcome, Failed)]
    assert (lost.task.pages, lost.problem.subject) == ((3, 4, 5), "recording /a.h5: pages 3-5")
    assert lost.problem.got == {"hang": "no answer", "die": "its end"}[kind]
    assert (engine.restarts, len(found), len(workers.started)) == (1 + ATTEMPTS, 3, len(workers.ended))


@pytest.fixture
def job(toy_zip: Path, tmp_path: Path) -> Job:
    toy.write_toy_recording(tmp_path / "a.h5", toy.ToyDevice(seed=1), 16, PAGES)
    choices = Choices(operation=Operation.DECODE, range_pages=RANGE, symbols=False)
    return of_recordings(choices, [str(tmp_path / "a.h5")], str(toy_zip), None)


def pages(out: Path) -> dict[str, list[PageRecord]]:
    """What the shards say of their pages."""
    found = out.glob("shards/*/*.json")
    return {path.name: list(ShardRecord.read(path.with_suffix("")).pages) for path in found}


def test_a_killed_worker_costs_a_restart_and_nothing_comes_out_differently(job: Job, tmp_path: Path) -> None:
    with Ledger(tmp_path / "single") as ledger:
        run(ledger, job, lambda: InlineEngine(Worker(1)))
    (tmp_path / f"a.6{KILLS}").write_text("1")
    engine, metrics = LocalEngine(2, 1, partial(started, target=WORKER)), BulkMetrics("killed", Operation.DECODE)
    with Ledger(tmp_path / "killed") as ledger:
        made = run(ledger, job, lambda: engine, metrics)
    shown, labels = metrics.registry.get_sample_value, {"run": "killed", "part": "0/1"}
    assert shown("lightpage_bulk_workers_died_total", labels) == made.restarts == 1
    assert shown("lightpage_bulk_workers", labels) == 0
    assert (made.failed, made.pages) == (0, PAGES)
    assert pages(tmp_path / "killed") == pages(tmp_path / "single")


def test_the_command_works_with_the_usual_workers(job: Job, tmp_path: Path) -> None:
    bundle, out = job.bundles[0].path, tmp_path / "out"
    asked = f"decode {out} --recordings {tmp_path / 'a.h5'} --bundle {bundle} --workers 1 --threads 1"
    assert run_command(bulk, asked.split()) == 0
    assert sum(len(read) for read in pages(out).values()) == PAGES


def test_a_run_that_ends_early_ends_workers_that_are_busy(job: Job, tmp_path: Path) -> None:
    begun = tmp_path / f"a{BEGUN}"
    begun.touch()

    def tasks() -> Iterator[Task]:
        yield next(Ledger(tmp_path / "out").missing(job))
        eventually(begun.read_text)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(LocalEngine(2, 1, partial(started, target=WORKER)).run(tasks()))
    assert not runs(int(begun.read_text()))


DRIVER = """
import sys
from functools import partial
from pathlib import Path
from lightpage.runtime.archives.run.driver import run
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.workers.local import LocalEngine, started
with Ledger(Path(sys.argv[1])) as ledger:
    run(ledger, Job.read(ledger.folder), lambda: LocalEngine(1, 1, partial(started, target=sys.argv[2])))
"""


def test_no_worker_outlives_a_driver_that_is_killed(job: Job, tmp_path: Path) -> None:
    begun = tmp_path / f"a{BEGUN}"
    begun.touch()
    with Ledger(tmp_path / "out") as ledger:
        job.write(ledger.folder)
    command = [sys.executable, "-c", DRIVER, str(tmp_path / "out"), WORKER]
    driver = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    try:
        worker = int(eventually(begun.read_text))
        driver.send_signal(signal.SIGKILL)
        driver.wait(LIMIT_S)
        eventually(lambda: not runs(worker))
        assert pages(tmp_path / "out") == {}
    finally:
        driver.kill()
        driver.wait()
