"""A cluster of workers, a driver and shared storage as queues: how many pages a second it reads.

Workers take page ranges from the driver, read each page from the storage while the page before it is decoded, and write
their results there. The driver serves one range at a time, as its loop does. So does the storage, page by page, first
come first served. A steady rate is what is asked for: the first and the last quarter of the ranges are not counted.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import simpy

_SATURATED = 0.9
"""Share of its time, or of its bytes a second, from which on a part is said to be saturated."""


@dataclass(frozen=True)
class Work:
    """Work of one worker.

    Attributes:
        page_seconds: mean seconds of a range's pages, one number for each range that was measured; drawn from at
            random.
        read_bytes: bytes of a page that are read from the storage.
        written_bytes: bytes of its result that are written to the storage.
        range_s: a worker's time for a range beside its pages: to be given it, and to write its record.
        range_pages: pages of a range.
    """

    page_seconds: Sequence[float]
    read_bytes: float
    written_bytes: float
    range_s: float
    range_pages: int

    @property
    def mean_s(self) -> float:
        """Seconds for a page, with its share of a range's overhead."""
        return float(np.mean(self.page_seconds)) + self.range_s / self.range_pages


@dataclass(frozen=True)
class Driver:
    """Cost of a range to the driver: `base_s`, and more for each range that is in flight.

    Attributes:
        base_s: seconds.
        in_flight_s: seconds for each range on its way.
        ahead: ranges on their way for each worker.
    """

    base_s: float
    in_flight_s: float
    ahead: int

    def range_s(self, workers: int) -> float:
        """Return the driver's seconds for a range with so many workers."""
        return self.base_s + self.in_flight_s * self.ahead * workers


@dataclass(frozen=True)
class Cluster:
    """A cluster.

    Attributes:
        nodes: how many.
        workers: workers of a node.
        storage_bytes_per_s: bandwidth that all nodes share.
        link_bytes_per_s: bandwidth of a node.
        mtbf_s: mean time between two failures of a node; None for none.
        repair_s: until a node that failed works again.
    """

    nodes: int
    workers: int
    storage_bytes_per_s: float
    link_bytes_per_s: float
    mtbf_s: float | None = None
    repair_s: float = 300.0


@dataclass(frozen=True)
class Rate:
    """Rate at which a cluster reads.

    Attributes:
        nodes: number of nodes.
        pages_per_s: rate of all nodes together.
        efficiency: share of the rate of as many workers that wait for nothing.
        driver, storage: how much of the driver's time, and of the storage's bytes a second, is used.
        lost_ranges: ranges that were given out again.
    """

    nodes: int
    pages_per_s: float
    efficiency: float
    driver: float
    storage: float
    lost_ranges: int

    @property
    def bound(self) -> str:
        """Name of the bottleneck: the driver, the storage or the workers."""
        name, use = max((("driver", self.driver), ("storage", self.storage)), key=lambda part: part[1])
        return name if use >= _SATURATED else "workers"


class _Line:
    """A server that does one thing after the other, as they come."""

    def __init__(self, per_s: float) -> None:
        self._per_s, self._free = per_s, 0.0

    def done(self, now: float, amount: float) -> float:
        """Queue an amount of work, and return the time at which it is done."""
        self._free = max(now, self._free) + amount / self._per_s
        return self._free


class _Run:
    """A run of a cluster over a number of ranges."""

    def __init__(self, cluster: Cluster, work: Work, driver: Driver, ranges: int, seed: int) -> None:
        self.cluster, self.work, self.driver, self.ranges = cluster, work, driver, ranges
        self.rng = np.random.default_rng(seed)
        self.environment = simpy.Environment()
        self.waiting, self.results = simpy.Store(self.environment), simpy.Store(self.environment)
        self.storage = _Line(cluster.storage_bytes_per_s)
        self.ends: list[float] = []
        self.lost = 0

    def finish(self) -> None:
        """Let it run to its end."""
        for _ in range(self.cluster.nodes):
            link = _Line(self.cluster.link_bytes_per_s)
            workers = [self.environment.process(self._worker(link)) for _ in range(self.cluster.workers)]
            if self.cluster.mtbf_s is not None:
                self.environment.process(self._failures(workers, self.cluster.mtbf_s))
        self.environment.run(self.environment.process(self._driver()))

    def _driver(self) -> Generator[simpy.Event, Any, None]:
        """Hands out ranges, a number ahead for each worker, and takes what comes back; one thing at a time."""
        most = self.driver.ahead * self.cluster.nodes * self.cluster.workers
        begun = in_flight = 0
        while len(self.ends) < self.ranges:
            while in_flight < most and begun < self.ranges:
                begun, in_flight = begun + 1, in_flight + 1
                yield self.waiting.put(None)
            read = yield self.results.get()
            yield self.environment.timeout(self.driver.base_s + self.driver.in_flight_s * in_flight)
            in_flight -= 1
            if read:
                self.ends.append(self.environment.now)
            else:
                begun, self.lost = begun - 1, self.lost + 1

    def _worker(self, link: _Line) -> Generator[simpy.Event, Any, None]:
        """Does ranges until its node fails, and again when it is back."""
        while True:
            asked = self.waiting.get()
            try:
                yield asked
                yield from self._range(link)
                yield self.results.put(True)
            except simpy.Interrupt:
                if asked.triggered:
                    yield self.results.put(False)
                else:
                    asked.cancel()
                yield self.environment.timeout(self.cluster.repair_s)

    def _range(self, link: _Line) -> Generator[simpy.Event, Any, None]:
        """A page is read while the one before it is decoded."""
        work, environment = self.work, self.environment
        seconds = work.page_seconds[int(self.rng.integers(len(work.page_seconds)))]
        yield environment.timeout(work.range_s)
        there = self._moved(link, work.read_bytes)
        yield environment.timeout(there - environment.now)
        for page in range(1, 1 + work.range_pages):
            there = self._moved(link, work.read_bytes) if page < work.range_pages else environment.now
            yield environment.timeout(max(seconds, there - environment.now))
        there = self._moved(link, work.written_bytes * work.range_pages)
        yield environment.timeout(there - environment.now)

    def _moved(self, link: _Line, amount: float) -> float:
        """Move so many bytes between storage and node, and return the time at which they have arrived."""
        now = self.environment.now
        return max(self.storage.done(now, amount), link.done(now, amount))

    def _failures(self, workers: Sequence[simpy.Process], mtbf_s: float) -> Generator[simpy.Event, Any, None]:
        while True:
            yield self.environment.timeout(self.rng.exponential(mtbf_s) + self.cluster.repair_s)
            for worker in workers:
                worker.interrupt()


def simulated(cluster: Cluster, work: Work, driver: Driver, *, ranges_per_worker: int = 12, seed: int = 0) -> Rate:
    """The steady rate of a cluster, all of whose workers begin at once."""
    workers = cluster.nodes * cluster.workers
    run = _Run(cluster, work, driver, workers * ranges_per_worker, seed)
    run.finish()
    first, last = len(run.ends) // 4, (3 * len(run.ends)) // 4
    pages_per_s = work.range_pages * (last - first) / (run.ends[last] - run.ends[first])
    return _rate(cluster, work, driver, pages_per_s, run.lost)


def whole_job_pages_per_s(cluster: Cluster, work: Work, driver: Driver, ranges: int, seed: int = 0) -> float:
    """The rate of a job of so many ranges from its first range's beginning to its last one's end."""
    run = _Run(cluster, work, driver, ranges, seed)
    run.finish()
    return work.range_pages * ranges / run.ends[-1]


def _rate(cluster: Cluster, work: Work, driver: Driver, pages_per_s: float, lost: int) -> Rate:
    """Use follows from the rate: what each page takes of a part, by how many there are a second."""
    workers = cluster.nodes * cluster.workers
    moved = work.read_bytes + work.written_bytes
    return Rate(
        nodes=cluster.nodes,
        pages_per_s=pages_per_s,
        efficiency=pages_per_s * work.mean_s / workers,
        driver=pages_per_s / work.range_pages * driver.range_s(workers),
        storage=pages_per_s * moved / cluster.storage_bytes_per_s,
        lost_ranges=lost,
    )


def nodes_that_saturate(cluster: Cluster, work: Work, driver: Driver) -> dict[str, float]:
    """Return how many nodes saturate the driver, and how many the storage, if no node waits for anything."""
    node_pages_per_s = cluster.workers / work.mean_s
    storage = cluster.storage_bytes_per_s / ((work.read_bytes + work.written_bytes) * node_pages_per_s)
    ranges_per_s = node_pages_per_s / work.range_pages
    base, more = driver.base_s * ranges_per_s, driver.in_flight_s * driver.ahead * cluster.workers * ranges_per_s
    if more:
        return {"storage": storage, "driver": (math.sqrt(base**2 + 4 * more) - base) / (2 * more)}
    return {"storage": storage, "driver": 1 / base if base else math.inf}
