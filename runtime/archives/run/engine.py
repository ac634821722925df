"""The interface of engines, which spread ranges over workers."""

import math
from collections import deque
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from typing import Protocol

from lightpage.runtime.archives.run.task import Failed, Outcome, Problem, Task

ATTEMPTS = 3
"""Times that a range is given to a worker; a range that has cost so many workers their life is left alone."""

THREADS_OF_WORKER = 2
"""Of an inference, where nothing else is asked for and there are as many cores: a second thread is worth nearly one
core, and a worker takes as much memory as `lightpage evaluate`."""

_START_S, _PAGE_S, _RECALIBRATION_S, _FINE_TUNING_S = 600.0, 60.0, 7200.0, 86_400.0
"""Longest time of a worker's start, of a page, of a recalibration, and of one that trains the network on; a worker that
takes longer is taken for dead."""


class Engine(Protocol):
    """Has workers do tasks."""

    restarts: int
    """Workers that died until now."""

    in_flight: int
    """Ranges that were handed out and have not come back."""

    workers_alive: int
    """Workers that are at work or wait for it; of a cluster, for how many its CPUs suffice."""

    def run(self, tasks: Iterable[Task]) -> Generator[Outcome, None, None]:
        """Return what became of each task, in whatever order they end; each exactly once.

        Tasks are taken from the iterable as workers become free, so that few are held at once. A worker that dies costs
        the range that it was at; that is given to another one, `ATTEMPTS` times in all. Workers end with
        the generator.

        Raises:
            WorkerError: there are no workers.
        """


@dataclass
class Attempt:
    """A task on its way.

    Attributes:
        task: what is asked.
        number: how many workers have died at it.
        deadline: until when it must be done, `time.monotonic` seconds; infinite until a worker has it.
    """

    task: Task
    number: int = 0
    deadline: float = math.inf


def longest_s(task: Task) -> float:
    """Seconds after which a worker that has not done a task is taken for dead."""
    if not task.recalibrates:
        return _START_S + _PAGE_S * len(task.pages)
    return _START_S + (_RECALIBRATION_S if task.choices.fine_tuning is None else _FINE_TUNING_S)


class Attempts:
    """Tasks yet to be handed out; those whose worker died come first."""

    def __init__(self, tasks: Iterable[Task]) -> None:
        self._following, self._again = iter(tasks), deque[Attempt]()

    def next(self) -> Attempt | None:
        """The next one; None after the last."""
        if self._again:
            return self._again.popleft()
        task = next(self._following, None)
        return None if task is None else Attempt(task)

    def died(self, attempt: Attempt, got: str) -> Failed | None:
        """Note that a worker has died; the task's outcome where it has cost too many, and else it comes again.

        Args:
            attempt: attempt that it was at.
            got: how it died, for people.
        """
        if attempt.number + 1 < ATTEMPTS:
            self._again.append(Attempt(attempt.task, attempt.number + 1))
            return None
        expected = f"a result; {ATTEMPTS} workers died at it"
        return Failed(task=attempt.task, problem=Problem(subject=attempt.task.name, got=got, expected=expected))
