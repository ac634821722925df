"""Workers that are processes of this machine."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Generator, Iterable, Sized

from pydantic import TypeAdapter

from lightpage.errors import WorkerError
from lightpage.failures import short_resource
from lightpage.helper_process import HelperProcess, same_packages
from lightpage.progress import note
from lightpage.runtime.archives.run.engine import THREADS_OF_WORKER, Attempt, Attempts, longest_s
from lightpage.runtime.archives.run.task import Outcome, Step, Task
from lightpage.runtime.model.execution.cpus import available_cpus

WORKER = "lightpage.runtime.archives.workers.local_worker"

_ANSWER: TypeAdapter[Outcome | Step] = TypeAdapter(Outcome | Step)

_SEND_S = 60.0
"""A task is a few kilobytes, and the worker waits for it."""


def default_workers() -> int:
    """How many workers this machine's cores keep busy."""
    return max(1, available_cpus() // THREADS_OF_WORKER)


def started(module: str, threads: int) -> HelperProcess:
    """Start a process that runs a module with so many threads.

    Raises:
        SurroundingsError, WorkerError: it cannot be started.
    """
    try:
        return HelperProcess(module, str(threads), subject="a worker", environment=same_packages(threads))
    except OSError as error:
        short = short_resource("a worker", error)
        raise short or WorkerError("a worker", error, "a process that can be started") from error


class LocalEngine:
    """Has processes of this machine do tasks; see `lightpage.runtime.archives.run.engine.Engine`.

    A worker has one task at a time, and is started with its first one.

    Args:
        workers: how many.
        threads: of each one's inferences; by default its share of the cores.
        module: what a worker runs.
        start: starts one, given module and threads.
        clock: by which one is too late.
    """

    def __init__(
        self,
        workers: int,
        threads: int | None = None,
        module: str = WORKER,
        start: Callable[[str, int], HelperProcess] = started,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.workers, self._module, self._start, self._clock = workers, module, start, clock
        self.threads = threads or max(1, available_cpus() // workers)
        self.restarts, self.in_flight, self.workers_alive = 0, 0, 0

    def run(self, tasks: Iterable[Task]) -> Generator[Outcome, None, None]:
        """See `Engine`."""
        attempts = Attempts(tasks)
        busy: dict[HelperProcess, Attempt] = {}
        free: list[HelperProcess] = []
        try:
            while True:
                while len(busy) < self.workers and (attempt := attempts.next()):
                    worker = free.pop() if free else self._start(self._module, self.threads)
                    busy[worker] = attempt
                    self._hand_over(worker, attempt)
                self._count(busy, free)
                if not busy:
                    return
                for worker in self._heard(busy):
                    attempt = busy.pop(worker)
                    try:
                        line = worker.line(attempt.deadline)
                    except OSError as error:
                        worker.end(grace_s=1.0)
                        self.restarts += 1
                        self._count(busy, free)
                        if (failed := attempts.died(attempt, _told(worker, error))) is not None:
                            yield failed
                        continue
                    answer = _ANSWER.validate_json(line)
                    if isinstance(answer, Step):
                        note(f"device {answer.device}: {answer.what}")
                        busy[worker] = attempt
                        continue
                    free.append(worker)
                    self._count(busy, free)
                    yield answer
        finally:
            for worker in (*busy, *free):
                worker.end()
            self._count({}, [])

    def _count(self, busy: Sized, free: Sized) -> None:
        self.in_flight, self.workers_alive = len(busy), len(busy) + len(free)

    def _hand_over(self, worker: HelperProcess, attempt: Attempt) -> None:
        """Send a task; a worker that cannot take it has died, which its socket tells."""
        attempt.deadline = self._clock() + longest_s(attempt.task)
        try:
            worker.send(attempt.task.model_dump_json().encode() + b"\n", self._clock() + _SEND_S)
        except OSError:
            worker.end()

    def _heard(self, busy: dict[HelperProcess, Attempt]) -> list[HelperProcess]:
        """Workers that have answered or ended, at least one; those whose time is up among them."""
        heard = [worker for worker in busy if worker.fileno() < 0 or worker.has_line()]
        if heard:
            return heard
        left = min(attempt.deadline for attempt in busy.values()) - self._clock()
        ready, _, _ = select.select(list(busy), [], [], max(0.0, left))
        now = self._clock()
        return ready or [worker for worker, attempt in busy.items() if attempt.deadline <= now]


def _told(worker: HelperProcess, error: Exception) -> str:
    """How a worker has ended, for people."""
    if isinstance(error, TimeoutError):
        return "no answer in time"
    status = worker.status
    if status is not None and status < 0:
        return f"the end of its worker by signal {-status}"
    return f"the end of its worker with status {status}"
