"""A worker that answers at once and reads nothing: what is left is what its driver takes."""

from __future__ import annotations

from lightpage.runtime.archives.run.task import Done, Outcome, Task
from lightpage.runtime.archives.workers.local_worker import LocalWorker
from lightpage.runtime.archives.workers.work import Worker


def nothing(task: Task, threads: int) -> Outcome:
    """The task is done."""
    return Done(task=task, lost={}, seconds=0.0)


class Idle(Worker):
    """Says that each task is done."""

    def work(self, task: Task) -> Outcome:
        """The task is done."""
        return nothing(task, 1)


class IdleWorker(LocalWorker):
    """Does nothing."""

    kind = Idle
