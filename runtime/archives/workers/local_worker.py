"""A worker's process, which `local` starts."""

from collections.abc import Callable
from typing import ClassVar

from lightpage.helper_process import Helper
from lightpage.runtime.archives.run.task import Outcome, Step, Task
from lightpage.runtime.archives.workers.work import Worker
from lightpage.runtime.model.execution.memory import share_freed_memory


class LocalWorker(Helper):
    """Does one task after the other."""

    kind: ClassVar[type[Worker]] = Worker

    def __init__(self) -> None:
        share_freed_memory()
        self._worker: Worker | None = None

    def work(self, task: Task, threads: int, progress: Callable[[Step], None]) -> Outcome:
        """Do a task with so many threads; see `Worker.work`."""
        self._worker = self._worker or self.kind(threads)
        self._worker.tell = progress
        return self._worker.work(task)
