"""Workers that are processes: what one that dies costs, and that none outlives its driver."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lightpage.cli.main import run as run_command
from lightpage.progress import reporting
from runtime.commands import bulk as command
from runtime.helper_process import HelperProcess
from runtime.scaling.driver import run
from runtime.scaling.engine import ATTEMPTS, Attempt
from runtime.scaling.inline import InlineEngine
from runtime.scaling.job import Choices, Job, of_recordings
from runtime.scaling.ledger import Ledger
from runtime.scaling.local import LocalEngine, _heard
from runtime.scaling.metrics import BulkMetrics
from runtime.scaling.shard import PageRecord, ShardRecord
from runtime.scaling.task import Operation
from runtime.scaling.totals import totals
from runtime.scaling.work import Worker
from tests.runtime import toy
from tests.runtime.scaling.deadly_worker import BEGUN, KILLS, TALKS
from tests.told import Told

ROOT = Path(__file__).resolve().parents[3]
WORKER = "tests.runtime.scaling.deadly_worker"
PAGES, RANGE = 12, 3
LIMIT_S = 60


@pytest.fixture
def job(toy_zip: Path, tmp_path: Path) -> Job:
    toy.write_toy_recording(tmp_path / "a.h5", toy.ToyDevice(seed=1), 16, PAGES)
    choices = Choices(operation=Operation.DECODE, range_pages=RANGE, symbols=False)
    return of_recordings(choices, [str(tmp_path / "a.h5")], str(toy_zip), None)


def pages(out: Path) -> dict[str, list[PageRecord]]:
    """What the shards say of their pages."""
    found = out.glob("shards/*/*.json")
    return {path.name: list(ShardRecord.read(path.with_suffix("")).pages) for path in found}


def test_a_killed_worker_costs_its_range_only_and_nothing_comes_out_differently(job: Job, tmp_path: Path) -> None:
    with Ledger(tmp_path / "single") as ledger:
        run(ledger, job, lambda: InlineEngine(Worker(1)))
    for first, kills in ((0, 1), (6, ATTEMPTS)):
        (tmp_path / f"a.{first}{KILLS}").write_text(str(kills))
    engine, metrics = LocalEngine(2, 1, WORKER), BulkMetrics("killed", Operation.DECODE)
    with Ledger(tmp_path / "killed") as ledger:
        job.write(ledger.folder)
        made = run(ledger, job, lambda: engine, metrics)
        found = totals(ledger, job)
    shown, labels = metrics.registry.get_sample_value, {"run": "killed", "part": "0/1"}
    assert shown("lightpage_bulk_workers_died_total", labels) == 1 + ATTEMPTS
    assert shown("lightpage_bulk_ranges_failed_total", labels) == 1
    assert shown("lightpage_bulk_workers", labels) == 0
    assert (made.restarts, made.failed, made.ranges) == (1 + ATTEMPTS, 1, 3)
    assert "pages 6-8: got the end of its worker by signal 9" in str(made.problems[0])
    assert (found.tally.read, found.tally.missing) == (PAGES - RANGE, RANGE)
    told = tmp_path / "J.json"  # the next run does what is missing, by the command and with the usual workers
    words = ["decode", str(tmp_path / "killed"), "--workers", "1", "--threads", "1", "--json", str(told)]
    assert run_command(command.bulk, words) == 0
    assert json.loads(told.read_text())["this_run"]["pages"] == RANGE
    assert pages(tmp_path / "killed") == pages(tmp_path / "single")


BULK = """
import sys
from lightpage.cli.main import run
from runtime.commands.bulk import bulk
sys.exit(run(bulk))
"""


def test_two_parts_as_two_processes_do_every_page_once(toy_zip: Path, tmp_path: Path) -> None:
    for number in range(3):
        toy.write_toy_recording(tmp_path / f"{number}.h5", toy.ToyDevice(seed=number), 16, PAGES, number)
    asked = ["--recordings", str(tmp_path / "?.h5"), "--bundle", str(toy_zip), "--range-pages", str(RANGE)]
    words = [sys.executable, "-c", BULK, "decode", str(tmp_path / "out"), "--no-symbols", *asked]
    words += ["--workers", "1", "--threads", "1"]
    parts = [
        subprocess.Popen([*words, "--part", f"{index}/2", "--json", str(tmp_path / f"{index}.json")], cwd=ROOT)
        for index in range(2)
    ]
    try:
        assert [part.wait(LIMIT_S) for part in parts] == [0, 0]
    finally:
        for part in parts:
            part.kill()
            part.wait()
    told = [json.loads((tmp_path / f"{index}.json").read_text()) for index in range(2)]
    assert [each["this_run"]["pages"] for each in told] == [2 * PAGES, PAGES]
    with Ledger(tmp_path / "out") as ledger:
        job = Job.read(ledger.folder)
        assert job is not None
        assert list(ledger.missing(job)) == []
        assert totals(ledger, job).tally.read == 3 * PAGES


def test_what_a_worker_is_at_is_told_as_it_comes_and_is_no_outcome(job: Job, tmp_path: Path) -> None:
    (tmp_path / f"a{TALKS}").touch()
    engine, at_work = LocalEngine(1, 1, WORKER), set()

    class Looking(Told):
        def note(self, what: str) -> None:
            super().note(what)
            at_work.add((engine.in_flight, engine.workers_alive))

    told = Looking()
    with Ledger(tmp_path / "out") as ledger, reporting(told):
        made = run(ledger, job, lambda: engine)
    assert (made.pages, made.ranges, made.restarts) == (PAGES, PAGES // RANGE, 0)
    assert (at_work, engine.in_flight, engine.workers_alive) == ({(1, 1)}, 0, 0)
    assert told.notes == [f"device a: {first}, {number}" for first in range(0, PAGES, RANGE) for number in range(3)]


def test_a_worker_whose_lines_came_at_once_is_heard_again_at_once(job: Job, tmp_path: Path) -> None:
    worker, (own, other) = HelperProcess.__new__(HelperProcess), socket.socketpair()  # without a process
    worker._link, worker._received = own, b""
    task = next(Ledger(tmp_path / "out").missing(job))
    with own, other:
        other.sendall(b"one\ntwo\n")
        end = time.monotonic() + 5.0
        assert worker.line(end) == b"one"
        assert _heard({worker: Attempt(task, deadline=end)}) == [worker]
        assert time.monotonic() < end
        assert worker.line(end) == b"two"


DRIVER = """
import sys
from pathlib import Path
from runtime.scaling.driver import run
from runtime.scaling.job import Job
from runtime.scaling.ledger import Ledger
from runtime.scaling.local import LocalEngine
with Ledger(Path(sys.argv[1])) as ledger:
    run(ledger, Job.read(ledger.folder), lambda: LocalEngine(1, 1, sys.argv[2]))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_no_worker_outlives_its_driver(job: Job, tmp_path: Path, number: int) -> None:
    begun = tmp_path / f"a{BEGUN}"
    begun.touch()
    with Ledger(tmp_path / "out") as ledger:
        job.write(ledger.folder)
    command = [sys.executable, "-c", DRIVER, str(tmp_path / "out"), WORKER]
    driver = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    try:
        worker = int(wait_for(begun.read_text))
        driver.send_signal(number)
        driver.wait(LIMIT_S)
        wait_for(lambda: not running(worker))
        assert pages(tmp_path / "out") == {}
    finally:
        driver.kill()
        driver.wait()


def running(process: int) -> bool:
    """Whether a process runs; one that nobody waits for does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_for(look: object) -> object:
    """What `look` gives once that is true."""
    end = time.monotonic() + LIMIT_S
    while not (found := look()):  # type: ignore[operator]
        assert time.monotonic() < end
        time.sleep(0.02)
    return found
