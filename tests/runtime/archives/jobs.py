"""Jobs, ranges and shards that are told alone: no file is there but what a test writes."""

from collections.abc import Callable, Generator, Iterable
from pathlib import Path

from lightpage.errors import InvalidInputError, StorageError
from lightpage.runtime.archives.run.job import Job, Source
from lightpage.runtime.archives.run.shard import PageRecord, PageState, ShardRecord
from lightpage.runtime.archives.run.task import Choices, Done, NamedBundle, Operation, Outcome, Problem, Stamp, Task

PAGES, RANGE = 7, 3
BUNDLE = NamedBundle(path=Path("/toy.zip"), sha256="0" * 64, version="toy-1")
NEWER = NamedBundle(path=Path("/newer.zip"), sha256="1" * 64, version="toy-2")

PASSES = Problem.of(StorageError("disk", "Input/output error", "data"))
STAYS = Problem.of(InvalidInputError("recording", "nothing", "a file"))


def source(name: str, problem: Problem | None = None, device: str = "", given_up: bool = False) -> Source:
    """A recording of seven pages, or one that could not be opened."""
    stamp = Stamp(size=1, modified_ns=1) if problem is None else None
    pages = PAGES if problem is None else 0
    path = Path(f"/{name}.h5")
    return Source(device=device, path=path, bundle=0, stamp=stamp, pages=pages, problem=problem, given_up=given_up)


def job(*sources: Source, rounds: tuple[NamedBundle, ...] = (), operation: Operation = Operation.DECODE) -> Job:
    """Of two recordings, where none are given."""
    choices = Choices(operation=operation, range_pages=RANGE)
    return Job(choices=choices, bundles=(BUNDLE,), sources=sources or (source("a"), source("b")), rounds=rounds)


def page(number: int, confirmed: float | None = None, due: bool = False, **figures: float) -> PageRecord:
    """One that was read."""
    return PageRecord(
        page=number, state=PageState.READ, recalibration_due=due, confirmed_bits=confirmed, figures=dict(figures)
    )


def lost(number: int, loss: str | None = "BlackFrameError", reason: str = "black") -> PageRecord:
    return PageRecord(page=number, state=PageState.LOST, loss=loss, reason=reason)


def write(shard: Path, *pages: PageRecord, model: NamedBundle = BUNDLE) -> None:
    """Write a range's result."""
    shard.parent.mkdir(parents=True, exist_ok=True)
    ShardRecord(model=model, pages=pages, seconds=2.0, finished_s=10.0, worker="here:1", read_bytes=5).write(shard)


class Works:
    """An engine that reads every range at once; `fails` may say what becomes of a task, that came so often before."""

    def __init__(self, fails: Callable[[Task, int], Outcome | None] = lambda task, before: None) -> None:
        self.restarts, self.in_flight, self.workers_alive = 0, 0, 1
        self.tasks: list[Task] = []
        self._fails = fails

    @property
    def firsts(self) -> list[tuple[str, int]]:
        """Recording and first page of every range that came."""
        return [(task.recording.stem, task.pages[0]) for task in self.tasks]

    def run(self, tasks: Iterable[Task]) -> Generator[Outcome, None, None]:
        for task in tasks:
            before = sum(other.shard == task.shard for other in self.tasks)
            self.tasks.append(task)
            if (outcome := self._fails(task, before)) is None:
                write(task.shard, *map(page, task.pages), model=task.bundle)
                outcome = Done(task=task, lost={}, seconds=2.0)
            yield outcome
