"""No workers: ranges are read by this process, one after the other. What all engines are measured against."""

from __future__ import annotations

from collections.abc import Generator, Iterable

from runtime.scaling.task import Outcome, Task
from runtime.scaling.work import Worker


class InlineEngine:
    """Does tasks itself; see `runtime.scaling.engine.Engine`.

    Args:
        worker: that does them.
    """

    restarts = 0

    def __init__(self, worker: Worker) -> None:
        self._worker = worker

    def run(self, tasks: Iterable[Task]) -> Generator[Outcome, None, None]:
        """See `Engine`; an error that nobody foresaw ends it."""
        for task in tasks:
            yield self._worker.work(task)
