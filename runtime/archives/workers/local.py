"""Workers that are processes of this machine."""

from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextvars import copy_context
from dataclasses import dataclass

from lightpage.errors import WorkerError
from lightpage.helper_process import HelperProcess, same_packages
from lightpage.progress import note
from lightpage.runtime.archives.run.engine import Attempt, Attempts, longest_s
from lightpage.runtime.archives.run.task import Outcome, Step, Task

WORKER = "lightpage.runtime.archives.workers.local_worker:LocalWorker"


def started(threads: int, target: str = WORKER) -> HelperProcess:
    """Start a `LocalWorker` with so many threads in a process of its own.

    Raises:
        WorkerError: it cannot be started.
    """
    return HelperProcess(target, subject="a worker", environment=same_packages(threads))


@dataclass
class LocalEngine:
    """Has processes of this machine do tasks; see `lightpage.runtime.archives.run.engine.Engine`.

    A worker has one task at a time, and is started with its first one. A thread waits for its answer.

    Attributes:
        workers: how many.
        threads: number of threads of each one's inferences.
        start: starts one with so many threads.
    """

    workers: int
    threads: int
    start: Callable[[int], HelperProcess] = started
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
                    except WorkerError as error:
                        worker.end(grace_s=1.0)
                        alive.remove(worker)
                        self.restarts += 1
                        outcome = attempts.died(attempt, error.got)
                    self.in_flight, self.workers_alive = len(busy), len(alive)
                    if outcome is not None:
                        yield outcome
            finally:
                for worker in alive:
                    worker.end()  # which wakes the thread that waits for its answer
                self.in_flight = self.workers_alive = 0

    def _answer(self, worker: HelperProcess, task: Task) -> Outcome:
        """Have a task done.

        Raises:
            WorkerError: the worker has died, or its time is up.
        """
        outcome: Outcome = worker.ask("work", task, self.threads, progress=_note, timeout_s=longest_s(task))
        return outcome


def _note(step: Step) -> None:
    note(f"device {step.device}: {step.what}")
