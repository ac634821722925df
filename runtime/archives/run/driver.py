"""Runs a job: hands out what is missing, counts what comes back, and holds no results."""

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from lightpage.clock import SYSTEM, Clock
from lightpage.progress import note, track, warn
from lightpage.runtime.archives.run.engine import Engine
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.task import Failed, Operation, Outcome, Problem, Task

AGAIN_S = (1.0, 4.0, 16.0)
"""Pauses before ranges are read again that had no result for a reason that may pass, e.g. a disk's hiccup."""

TOLD = 5
"""Ranges without a result whose reasons are kept; the others are counted."""


@dataclass
class Progressed:
    """Progress of one run.

    Attributes:
        pages: pages that were read, or are lost.
        lost: number of these that are lost.
        ranges: ranges that have a result now.
        failed: ranges, or recordings, without one.
        given_up: recordings that could not be opened, and are lost.
        problems: why, of the first of them.
        failures: why, of each device that is recalibrated, by its name and first recording.
        restarts: workers that died.
        seconds: time that it took.
    """

    pages: int = 0
    lost: int = 0
    ranges: int = 0
    failed: int = 0
    given_up: int = 0
    problems: list[Problem] = field(default_factory=list)
    failures: dict[tuple[str, Path], Problem] = field(default_factory=dict)
    restarts: int = 0
    seconds: float = 0.0

    @property
    def pages_per_s(self) -> float | None:
        """Return the pages a second of all workers together; None where nothing was to do, or it took no time."""
        return self.pages / self.seconds if self.pages and self.seconds else None

    def count(self, outcome: Outcome) -> int:
        """Count an outcome and return how much of the work it was worth."""
        if isinstance(outcome, Failed):
            if outcome.task.recalibrates:
                self.failures[outcome.task.origin] = outcome.problem
            self.fail(outcome.problem.about(outcome.task.device))
            return 0
        self.ranges += 1
        self.pages += outcome.task.weight
        self.lost += sum(outcome.lost.values())
        return outcome.task.weight

    def fail(self, problem: Problem) -> None:
        """Count what has no result."""
        self.failed += 1
        if len(self.problems) < TOLD:
            self.problems.append(problem)
        warn(str(problem))

    def state(self) -> str:
        """Return the state in words, for a progress bar."""
        parts = {"lost": self.lost, "failed": self.failed, "workers died": self.restarts}
        return ", ".join(f"{name} {count}" for name, count in parts.items() if count)


class Watch:
    """Is told how a run fares; this one makes nothing of it."""

    def wanted(self, total: int, left: int) -> None:
        """So many pages has the job, or devices, and so many are to be read now."""

    def begin(self, engine: Engine) -> None:
        """This engine works from now on."""

    def count(self, outcome: Outcome) -> None:
        """This has become of a range."""

    def fail(self) -> None:
        """A recording or bundle cannot be opened, or a device lacks something: no range of it is handed out."""

    def deaths(self, count: int) -> None:
        """So many workers have died."""


_NOBODY = Watch()


def run(
    ledger: Ledger,
    job: Job,
    engine: Callable[[], Engine],
    watch: Watch = _NOBODY,
    *,
    give_up: bool = False,
    clock: Clock = SYSTEM,
) -> Progressed:
    """Do all that is missing of a job: its first reading, then its rounds one after the other.

    Ranges that fail for a reason that may pass are tried again after each pause of `AGAIN_S`. What still fails is told
    and left to the next run; all else goes on.

    Args:
        ledger: ledger of the job, which belongs to this process, or a part of it.
        job: what was asked.
        engine: makes the engine; not called where nothing is missing.
        watch: is told how it fares.
        give_up: whether pages of recordings that cannot be read in the end are lost.
        clock: clock of the pauses.

    Raises:
        WorkerError: there are no workers.
        InvalidInputError: a shard cannot be read.
    """
    start = clock.now()
    made = Progressed()
    ledger.sweep(job)
    for problem, is_given_up in dict.fromkeys(  # a bundle is lacking to all recordings of its device
        (source.problem.about(source.device), source.given_up)
        for _, source in ledger.part.sources(job)
        if source.problem is not None
    ):
        if is_given_up:
            made.given_up += 1
            continue
        made.fail(problem)
        watch.fail()
    unit = "device" if job.choices.operation is Operation.RECALIBRATE else "page"
    pauses_s = (None, *AGAIN_S, *([0.0] if give_up else []))
    try:
        for number in range(1 + len(job.rounds)):
            missing = partial(ledger.missing_again, job, number) if number else partial(ledger.missing, job)
            todo, whole = sum(task.weight for task in missing()), _all(ledger, job)
            watch.wanted(whole, todo)
            if not todo:
                continue
            total = todo if number else whole
            what = f"{job.choices.operation} again" if number else str(job.choices.operation)
            failed, counted = list[Failed](), list[Failed]()
            for turn, pause_s in enumerate(pauses_s, 1):
                last = turn == len(pauses_s)
                every = give_up and last
                tasks: Iterable[Task] = missing()
                if pause_s is not None:
                    again = [each for each in failed if every or each.problem.passes]
                    if not again:
                        continue
                    failed = [each for each in failed if not (every or each.problem.passes)]
                    tasks = list(_of_failures(tasks, again, [*failed, *counted], every))
                    todo = sum(task.weight for task in tasks)
                    note(f"{again[0].problem}; {todo} {unit}s are tried again in {pause_s:g} s")
                    clock.sleep(pause_s)

                def later(one: Failed, last: bool = last) -> bool:
                    return not last and (give_up or one.problem.passes)

                works = engine()
                watch.begin(works)
                with closing(_steps(works, tasks, ledger, made, watch, later, failed, counted)) as steps:
                    for _ in track(steps, what, unit=unit, total=total, done=total - todo, state=made.state):
                        pass
    finally:
        ledger.sweep(job)
    made.seconds = clock.now() - start
    return made


def _of_failures(tasks: Iterable[Task], again: list[Failed], settled: list[Failed], give_up: bool) -> Iterator[Task]:
    """Tasks of the recordings that failures `again` are of, but for those that are `settled`."""
    recordings = {failed.task.origin for failed in again}
    recordings -= {failed.task.origin for failed in settled if failed.whole_recording}
    shards = {failed.task.shard for failed in settled}
    for task in tasks:
        if task.origin in recordings and task.shard not in shards:
            yield task.model_copy(update={"give_up": give_up})


def _steps(
    engine: Engine,
    tasks: Iterable[Task],
    ledger: Ledger,
    made: Progressed,
    watch: Watch,
    later: Callable[[Failed], bool],
    failed: list[Failed],
    counted: list[Failed],
) -> Generator[None, None, None]:
    """Do tasks; once for every page that is behind.

    Args:
        engine: engine of the run.
        tasks: tasks to do.
        ledger: ledger of the run.
        made, watch: counters of outcomes.
        later: whether a failure is added to `failed`, in place of being counted.
        failed: list of failures that are tried again.
        counted: list of failures that are not.
    """
    given_up: set[tuple[str, Path]] = set()
    died = made.restarts

    def count_deaths() -> None:
        more, made.restarts = died + engine.restarts - made.restarts, died + engine.restarts
        watch.deaths(more)

    def wanted() -> Iterator[Task]:
        return (task for task in tasks if task.origin not in given_up)

    with closing(engine.run(wanted())) as outcomes:
        for outcome in outcomes:
            count_deaths()
            if isinstance(outcome, Failed):
                origin = outcome.task.origin
                if outcome.whole_recording and origin in given_up:
                    continue  # it was under way when the recording was found to be unreadable, and is told already
                if outcome.whole_recording:
                    given_up.add(origin)
                if later(outcome):
                    failed.append(outcome)
                    continue
                counted.append(outcome)
            else:
                ledger.doubted.discard(outcome.task.shard)
            watch.count(outcome)
            for _ in range(made.count(outcome)):
                yield None
    count_deaths()


def _all(ledger: Ledger, job: Job) -> int:
    """Pages of the ledger's part of the job, or devices."""
    if job.choices.operation is Operation.RECALIBRATE:
        return sum(all(source.problem is None for source in own) for _, own in ledger.part.devices(job))
    return sum(source.pages for _, source in ledger.part.sources(job))
