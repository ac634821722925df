"""No workers: ranges are read by this process, one after the other. What all engines are measured against."""

from __future__ import annotations

from collections.abc import Generator, Iterable

from lightpage.runtime.archives.run.task import Outcome, Task
from lightpage.runtime.archives.workers.work import Worker


class InlineEngine:
    """Does tasks itself; see `lightpage.runtime.archives.run.engine.Engine`.

    Args:
        worker: that does them.
    """

    restarts, in_flight, workers_alive = 0, 0, 1

    def __init__(self, worker: Worker) -> None:
        self._worker = worker

    def run(self, tasks: Iterable[Task]) -> Generator[Outcome, None, None]:
        """See `Engine`; an error that nobody foresaw ends it."""
        for task in tasks:
            self.in_flight = 1
            outcome = self._worker.work(task)
            self.in_flight = 0
            yield outcome
