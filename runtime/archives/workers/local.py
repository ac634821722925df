"""Workers that are processes of this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextvars import copy_context
from dataclasses import dataclass

from pydantic import TypeAdapter

from lightpage.errors import WorkerError
from lightpage.failures import os_errors
from lightpage.helper_process import HelperProcess, same_packages
from lightpage.progress import note
from lightpage.runtime.archives.run.engine import Attempt, Attempts, longest_s
from lightpage.runtime.archives.run.task import Outcome, Step, Task

WORKER = "lightpage.runtime.archives.workers.local_worker"

_ANSWER: TypeAdapter[Outcome | Step] = TypeAdapter(Outcome | Step)


def started(threads: int, module: str = WORKER) -> HelperProcess:
    """Start a process that runs a module with so many threads.

    Raises:
        SurroundingsError, StorageError, WorkerError: it cannot be started.
    """
    with os_errors("a worker", "a process that can be started", WorkerError):
        return HelperProcess(module, str(threads), subject="a worker", environment=same_packages(threads))


@dataclass
class LocalEngine:
    """Has processes of this machine do tasks; see `lightpage.runtime.archives.run.engine.Engine`.

    A worker has one task at a time, and is started with its first one. A thread waits for its answer.

    Attributes:
        workers: how many.
        threads: of each one's inferences.
        start: starts one with so many threads.
        clock: by which one is too late.
    """

    workers: int
    threads: int
    start: Callable[[int], HelperProcess] = started
    clock: Callable[[], float] = time.monotonic
    restarts: int = 0
    in_flight: int = 0
    workers_alive: int = 0

    def run(self, tasks: Iterable[Task]) -> Generator[Outcome, None, None]:
        """See `Engine`."""
        attempts = Attempts(tasks)
        alive, free = list[HelperProcess](), list[HelperProcess]()
        busy: dict[Future[Outcome], tuple[HelperProcess, Attempt]] = {}
        with ThreadPoolExecutor(self.workers) as waiting:
            try:
                while True:
                    while len(busy) < self.workers and (attempt := attempts.next()):
                        if not free:
                            free.append(self.start(self.threads))
                            alive.append(free[0])
                        worker = free.pop()
                        busy[waiting.submit(copy_context().run, self._answer, worker, attempt.task)] = worker, attempt
                    self.in_flight, self.workers_alive = len(busy), len(alive)
                    if not busy:
                        return
                    answered = wait(busy, return_when=FIRST_COMPLETED).done.pop()
                    worker, attempt = busy.pop(answered)
                    outcome: Outcome | None
                    try:
                        outcome = answered.result()
                        free.append(worker)
                    except OSError as error:
                        worker.end(grace_s=1.0)
                        alive.remove(worker)
                        self.restarts += 1
                        outcome = attempts.died(attempt, _told(worker, error))
                    self.in_flight, self.workers_alive = len(busy), len(alive)
                    if outcome is not None:
                        yield outcome
            finally:
                for worker in alive:  # which wakes the threads that wait for their answers
                    worker.end()
                self.in_flight = self.workers_alive = 0

    def _answer(self, worker: HelperProcess, task: Task) -> Outcome:
        """Hand over a task and wait until it is done.

        Raises:
            OSError: the worker has died, or its time is up.
        """
        deadline = self.clock() + longest_s(task)
        worker.send(task.model_dump_json().encode() + b"\n", deadline)
        while isinstance(answer := _ANSWER.validate_json(worker.line(deadline)), Step):
            note(f"device {answer.device}: {answer.what}")
        return answer


def _told(worker: HelperProcess, error: Exception) -> str:
    """How a worker has ended, for people."""
    if isinstance(error, TimeoutError):
        return "no answer in time"
    status = worker.status or 0
    return "the end of its worker " + (f"by signal {-status}" if status < 0 else f"with status {status}")
