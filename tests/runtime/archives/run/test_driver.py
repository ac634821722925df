"""The driver: hands out what is missing, tries again what may pass, and counts what became of everything."""

from pathlib import Path
from typing import Any

import pytest

from lightpage.runtime.archives.run import driver
from lightpage.runtime.archives.run.driver import AGAIN_S, Progressed, Watch, run
from lightpage.runtime.archives.run.engine import Engine
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.task import Done, Failed, Outcome, Task
from tests.clock import HandClock
from tests.runtime.archives.jobs import NEWER, PAGES, PASSES, RANGE, STAYS, Works, job, lost, page, source, write


class Seen(Watch):
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, int]] = []
        self.outcomes: list[Outcome] = []
        self.died: list[int] = []
        self.failures, self.engines = 0, list[Engine]()

    def wanted(self, total: int, left: int) -> None:
        self.asked.append((total, left))

    def begin(self, engine: Engine) -> None:
        self.engines.append(engine)

    def count(self, outcome: Outcome) -> None:
        self.outcomes.append(outcome)

    def fail(self) -> None:
        self.failures += 1

    def deaths(self, count: int) -> None:
        self.died.append(count)


def done(folder: Path, what: Job, works: Works, **more: Any) -> tuple[Progressed, float, Seen]:
    """What a run has done, the seconds that it waited, and what it told."""
    clock, seen = HandClock(), Seen()
    start = clock.now()
    with Ledger(folder) as ledger:
        made = run(ledger, what, lambda: works, seen, clock=clock, **more)
    return made, clock.now() - start, seen


def test_every_range_is_handed_out_once_and_then_none(tmp_path: Path) -> None:
    made, waited, seen = done(tmp_path, job(), works := Works())
    assert works.firsts == [("a", 0), ("a", 3), ("a", 6), ("b", 0), ("b", 3), ("b", 6)]
    assert (made.pages, made.ranges, made.lost, made.failed, made.problems) == (2 * PAGES, 6, 0, 0, [])
    assert (waited, made.seconds, made.pages_per_s) == (0, 0, None)
    assert seen.asked == [(2 * PAGES, 2 * PAGES)]
    assert (seen.engines, len(seen.outcomes), seen.failures) == ([works], 6, 0)
    made, _, seen = done(tmp_path, job(), works := Works())
    assert (works.tasks, made.pages, seen.asked, seen.engines) == ([], 0, [(2 * PAGES, 0)], [])


def test_speed_and_lost_pages_are_counted(tmp_path: Path) -> None:
    clock = HandClock()

    def slow(task: Task, before: int) -> Outcome | None:
        clock.advance(2.0)
        if task.pages[0]:
            return None
        write(task.shard, *map(lost, task.pages))
        return Done(task=task, lost={"BlackFrameError": 2, "Another": 1}, seconds=2.0)

    with Ledger(tmp_path) as ledger:
        made = run(ledger, job(), lambda: Works(slow), clock=clock)
    assert (made.pages, made.lost, made.seconds) == (2 * PAGES, 2 * RANGE, 12.0)
    assert made.pages_per_s == pytest.approx(2 * PAGES / 12)
    assert made.state() == "lost 6"


@pytest.mark.parametrize("tries", [3, 4])
def test_what_may_pass_is_tried_again_after_ever_longer_pauses_and_then_told_once(tries: int, tmp_path: Path) -> None:
    def hiccup(task: Task, before: int) -> Outcome | None:
        return Failed(task=task, problem=PASSES) if task.pages[0] == RANGE and before < tries else None

    made, waited, seen = done(tmp_path, job(source("a")), works := Works(hiccup))
    assert AGAIN_S == (1, 4, 16)
    assert works.firsts == [("a", 0), ("a", 3), ("a", 6), *[("a", 3)] * min(tries, 3)]
    assert waited == sum(AGAIN_S[:tries])
    assert (made.pages, made.problems) == ((PAGES, []) if tries < 4 else (PAGES - RANGE, [PASSES]))
    assert (made.failed, len(seen.outcomes)) == (len(made.problems), 3)


@pytest.mark.parametrize(("problem", "again"), [(STAYS, 0), (PASSES, len(AGAIN_S))])
def test_a_recording_that_cannot_be_read_is_left_alone_and_the_next_one_is_read(
    problem: Any, again: int, tmp_path: Path
) -> None:
    def gone(task: Task, before: int) -> Outcome | None:
        whole = Failed(task=task, problem=problem, whole_recording=True)
        return whole if task.recording.stem == "a" and task.pages[0] else None

    made, waited, _ = done(tmp_path, job(), works := Works(gone))
    assert works.firsts[:5] == [("a", 0), ("a", 3), ("b", 0), ("b", 3), ("b", 6)]
    assert works.firsts[5:] == [("a", 3)] * again
    assert (made.failed, made.pages, waited) == (1, RANGE + PAGES, sum(AGAIN_S[:again]))


@pytest.mark.parametrize(("problem", "waits"), [(STAYS, 0), (PASSES, sum(AGAIN_S))])
def test_what_is_given_up_is_read_a_last_time_by_a_worker_that_may_file_it_as_lost(
    problem: Any, waits: float, tmp_path: Path
) -> None:
    def fails(task: Task, before: int) -> Outcome | None:
        return None if task.give_up or task.pages[0] != RANGE else Failed(task=task, problem=problem)

    made, waited, _ = done(tmp_path, job(source("a")), works := Works(fails), give_up=True)
    assert [task.pages[0] for task in works.tasks if task.give_up] == [RANGE]
    assert works.tasks[-1].give_up
    assert (made.failed, made.pages, waited) == (0, PAGES, waits)


def test_recordings_that_could_not_be_opened_are_told_and_those_given_up_are_counted(tmp_path: Path) -> None:
    asked = job(source("a"), source("b", STAYS), source("c", PASSES, given_up=True))
    made, _, seen = done(tmp_path, asked, Works())
    assert (made.failed, made.given_up, made.problems, seen.failures) == (1, 1, [STAYS], 1)
    assert seen.asked == [(PAGES, PAGES)]


def test_all_failures_are_counted_and_the_first_are_told(tmp_path: Path) -> None:
    made, _, _ = done(tmp_path, job(), Works(lambda task, before: Failed(task=task, problem=STAYS)))
    assert (made.failed, len(made.problems), made.state()) == (6, driver.TOLD, "failed 6")


def test_workers_that_died_are_told_as_they_die(tmp_path: Path) -> None:
    engines, seen = list[Works](), Seen()

    def deadly(task: Task, before: int) -> Outcome | None:
        engines[-1].restarts += 1
        return Failed(task=task, problem=PASSES) if task.pages[0] == 0 and len(engines) == 1 else None

    def engine() -> Works:
        engines.append(Works(deadly))
        return engines[-1]

    with Ledger(tmp_path) as ledger:
        made = run(ledger, job(source("a")), engine, seen, clock=HandClock())
    assert (made.restarts, [died for died in seen.died if died], made.state()) == (4, [1] * 4, "workers died 4")


def test_a_round_reads_again_what_was_not_read_well_and_what_is_worse_does_not_count(tmp_path: Path) -> None:
    asked = job(source("a"), rounds=(NEWER,))
    with Ledger(tmp_path) as ledger:
        write(ledger.shard(0, 0), page(0), page(1, 0.5, due=True), lost(2))
        write(ledger.shard(0, 3), *map(page, (3, 4, 5)))
    made, _, seen = done(tmp_path, asked, works := Works())
    assert [(task.pages, task.bundle.version) for task in works.tasks] == [((6,), "toy-1"), ((1, 2), "toy-2")]
    assert seen.asked == [(PAGES, 1), (PAGES, 2)]
    assert made.pages == 3
    with Ledger(tmp_path) as ledger:
        best = ledger.pages(0, 0, ledger.results(0), 2)
    assert [(each.page, each.confirmed_bits, each.state) for each in best] == [
        (0, None, "read"),
        (1, 0.5, "read"),
        (2, None, "read"),
    ]
    assert done(tmp_path, asked, works := Works())[0].pages == 0
