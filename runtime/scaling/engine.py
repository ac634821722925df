"""How ranges are spread over workers: one small interface, of which there are several engines."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from typing import Protocol

from runtime.scaling.task import Failed, Outcome, Problem, Task

ATTEMPTS = 3
"""Times that a range is given to a worker; a range that has cost so many workers their life is left alone."""


class Engine(Protocol):
    """Has workers do tasks."""

    restarts: int
    """Workers that died until now."""

    def run(self, tasks: Iterable[Task]) -> Generator[Outcome, None, None]:
        """What became of each task, in whatever order they end; each exactly once.

        Tasks are taken from the iterable as workers become free, so that few are held at once. A worker that dies costs
        the range that it was at; that is given to another one, `ATTEMPTS` times in all. Workers end with
        the generator.

        Raises:
            WorkerError: there are no workers.
        """


def given_up(task: Task, got: str) -> Failed:
    """The outcome of a task that has cost too many workers their life."""
    expected = f"a result; {ATTEMPTS} workers died at it"
    return Failed(task=task, problem=Problem(subject=task.name, got=got, expected=expected))
