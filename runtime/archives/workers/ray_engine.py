"""Workers on a Ray cluster, or on one that is started on this machine. Ray is imported when it is asked for."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING, Any

from lightpage.errors import InvalidInputError, WorkerError
from lightpage.failures import short_resource
from lightpage.helper_process import same_packages
from lightpage.runtime.archives.run.engine import THREADS_OF_WORKER, Attempt, Attempts, longest_s
from lightpage.runtime.archives.run.task import Outcome, Task
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.runtime.model.execution.memory import SHARED
from lightpage.temporary import SOCKET_BYTES, short_folder

if TYPE_CHECKING:
    from lightpage.runtime.archives.workers.work import Worker

AHEAD = 2
"""Tasks on their way for each that the cluster can work on: a worker that ends one finds the next one waiting."""

_STORE_BYTES = 128 << 20
"""Of the object store of a cluster that is started here; tasks and outcomes are a few kilobytes."""

_BELOW_FOLDER = len("/session_2026-01-01_00-00-00_123456_1234567/sockets/plasma_store_0")
"""Bytes of the longest path of a socket that Ray makes in its folder."""

_LOOPBACK = "127.0.0.1"


class RayEngine:
    """Has Ray tasks do tasks; see `lightpage.runtime.archives.run.engine.Engine`.

    A process of Ray keeps its decoder from one task to the next. Ray's own retries are off: a task of a worker or node
    that dies is given out again by this engine, and so is one whose worker does not answer in time; that one is killed.
    Time that a task waits for a worker is not counted. Recordings, bundles and the run's folder must be there on every
    node.

    Args:
        address: address of a cluster, `auto` for one that runs on this machine; None to start one here, for this run.
        workers: most ranges at once; by default as many as the cluster's CPUs allow at any time.
        threads: CPUs of a worker, and threads of its inferences; by default `THREADS_OF_WORKER`, or what a node has.
        work: what a worker does with a task and so many threads.
        gpus: number of GPUs of a worker, 0 or 1: Ray shows it that one alone.
        clock: clock by which a worker is too late.
    """

    def __init__(
        self,
        address: str | None = None,
        workers: int | None = None,
        threads: int | None = None,
        work: Callable[[Task, int], Outcome] | None = None,
        gpus: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._address, self._workers, self._work = address, workers, work or _work
        self._threads, self._gpus, self._clock = threads, gpus, clock
        self.restarts, self.in_flight, self.workers_alive = 0, 0, 0

    def run(self, tasks: Iterable[Task]) -> Generator[Outcome, None, None]:
        """See `Engine`.

        Raises:
            WorkerError: no cluster, one that does not answer, or one that has lost all its workers.
            InvalidInputError: no node has as many CPUs as a worker takes, or a GPU if it takes one.
            ModuleNotFoundError: Ray is not installed: the extra cluster brings it.
        """
        with connected(self._address) as ray:
            yield from self._run(ray, Attempts(tasks))

    def _run(self, ray: Any, attempts: Attempts) -> Generator[Outcome, None, None]:
        threads = self._threads_of(ray)
        work = ray.remote(self._work).options(num_cpus=threads, num_gpus=self._gpus, max_retries=0)
        busy: dict[Any, Attempt] = {}
        try:
            while True:
                self._count(ray, threads)
                most = self._workers or max(1, self.workers_alive) * AHEAD
                while len(busy) < most and (attempt := attempts.next()):
                    busy[work.remote(attempt.task, threads)] = attempt
                self.in_flight = len(busy)
                if not busy:
                    return
                for attempt in islice(busy.values(), max(1, self.workers_alive)):  # Ray begins them in this order
                    attempt.deadline = min(attempt.deadline, self._clock() + longest_s(attempt.task))
                left_s = min(attempt.deadline for attempt in busy.values()) - self._clock()
                ready, _ = ray.wait(list(busy), num_returns=1, timeout=max(0.0, left_s))
                for ref in ready or self._overdue(ray, threads, busy):
                    attempt = busy.pop(ref)
                    self.in_flight = len(busy)
                    try:
                        if not ready:
                            ray.cancel(ref, force=True)  # nobody hears what it may answer still
                            raise TimeoutError("no answer in time")
                        outcome: Outcome | None = ray.get(ref)
                    except (ray.exceptions.RayError, TimeoutError) as error:
                        self.restarts += 1
                        outcome = attempts.died(attempt, _told(error))
                    if outcome is not None:
                        yield outcome
        finally:
            for ref in busy:
                ray.cancel(ref, force=True)
            self.in_flight = self.workers_alive = 0

    def _threads_of(self, ray: Any) -> int:
        """CPUs of a worker, at most as many as the largest node has.

        Raises:
            InvalidInputError: more are asked for.
        """
        largest = max((int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]), default=0)
        if self._gpus and not ray.cluster_resources().get("GPU"):
            raise InvalidInputError("the Ray cluster", "no GPU", "a node with one, or provider cpu")
        if self._threads is not None and self._threads > largest:
            raise InvalidInputError("--threads", f"{self._threads}, and nodes of {largest} CPUs", "one that has them")
        return self._threads or max(1, min(THREADS_OF_WORKER, largest))

    def _overdue(self, ray: Any, threads: int, busy: dict[Any, Attempt]) -> list[Any]:
        """Tasks whose time is up.

        Raises:
            WorkerError: there is no worker that could have done one.
        """
        self._count(ray, threads)
        if not self.workers_alive:
            raise WorkerError("the Ray cluster", "no workers any more", "nodes that have what a worker takes")
        now = self._clock()
        return [ref for ref, attempt in busy.items() if attempt.deadline <= now]

    def _count(self, ray: Any, threads: int) -> None:
        """Look for how many workers the cluster suffices now."""
        there = ray.cluster_resources()
        room = int(there.get("CPU", 0)) // threads
        if self._gpus:
            room = min(room, int(there.get("GPU", 0)) // self._gpus)
        self.workers_alive = room if self._workers is None else min(room, self._workers)


_worker: Worker | None = None
"""Of a process of Ray: its decoder stays warm."""


def _work(task: Task, threads: int) -> Outcome:
    """Do a task, in a process of Ray."""
    global _worker
    if _worker is None:
        from lightpage.runtime.archives.workers.work import Worker

        _worker = Worker(threads)
    return _worker.work(task)


@contextmanager
def connected(address: str | None) -> Iterator[Any]:
    """Ray, connected to a cluster; a cluster that was started for it ends with it."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # before it is imported: nothing is sent to anybody
    import ray

    if ray.is_initialized():
        yield ray
        return
    subject = f"Ray cluster {address or 'of this machine'}"
    settings: dict[str, Any] = {"address": address}
    expected = "one that answers"
    folder = None
    if address is None:
        folder = short_folder(subject, "ray-", SOCKET_BYTES - _BELOW_FOLDER)
        settings = {
            "address": "local",  # whatever RAY_ADDRESS says
            "num_cpus": available_cpus(),
            "include_dashboard": False,
            "object_store_memory": _STORE_BYTES,
            "_temp_dir": folder.name,
            "_node_ip_address": _LOOPBACK,
        }
        expected = "one that starts: Ray writes to the folders that the variables TMPDIR and HOME name"
    # Ray's process has many threads before a task comes: then it is too late to tell the C library of memory.
    packages = {"env_vars": {"PYTHONPATH": same_packages(1)["PYTHONPATH"], **SHARED}}
    try:
        try:
            ray.init(log_to_driver=False, logging_level=logging.ERROR, runtime_env=packages, **settings)
        except (OSError, RuntimeError, ValueError) as error:
            short = short_resource(subject, error)
            raise short or WorkerError(subject, f"{error}", expected) from error
        yield ray
    finally:
        ray.shutdown()
        if folder is not None:
            folder.cleanup()


def _told(error: Exception) -> str:
    """The first line of what Ray says."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
