"""Prometheus metrics of a bulk run: served while it works, written to a file after its end."""

import time
from collections.abc import Iterable
from pathlib import Path

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from lightpage.codec.page_bytes import Loss
from lightpage.errors import Reason
from lightpage.files import replace_text
from lightpage.runtime.archives.run.driver import Watch
from lightpage.runtime.archives.run.engine import Engine
from lightpage.runtime.archives.run.ledger import WHOLE, Part
from lightpage.runtime.archives.run.shard import PageState
from lightpage.runtime.archives.run.task import Failed, Operation, Outcome

_SECONDS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 20.0, 60.0, 300.0, 1800.0, 7200.0)
"""From a page of the fast preset to the recalibration of a large device."""

_UNCONFIRMED = (Reason.PILOTS_DISAGREE, Reason.IMAGE_NOT_FOUND, Reason.TOO_FEW_PILOTS)
_CAUSES: dict[Operation, Iterable[str]] = {
    Operation.DECODE: _UNCONFIRMED,
    Operation.EVALUATE: _UNCONFIRMED,
    Operation.RECOVER: Loss,
}
"""What pages may be lost by; errors of other names may come beside them."""


class BulkMetrics(Watch):
    """The figures of one run. All have the labels `run` and `part`, so that files of many may lie in one folder.

    Args:
        run: name of the run's folder.
        operation: what it does.
        part: what this process does of it.
    """

    def __init__(self, run: str, operation: Operation, part: Part = WHOLE) -> None:
        self.registry = own = CollectorRegistry()
        self._own = values = run, str(part)
        one = ["run", "part"]

        def counter(name: str, what: str) -> Counter:
            return Counter(name, what, one, registry=own).labels(*values)

        def gauge(name: str, what: str) -> Gauge:
            return Gauge(name, what, one, registry=own).labels(*values)

        # What has its labels is shown at once: Prometheus sees no rise from nothing to the first one.
        self._pages = Counter("lightpage_bulk_pages", "Pages or devices, by outcome.", [*one, "state"], registry=own)
        self._lost = Counter("lightpage_bulk_pages_lost", "Lost pages, by cause.", [*one, "reason"], registry=own)
        for state in PageState:
            self._pages.labels(*values, state)
        for reason in _CAUSES.get(operation, ()):
            self._lost.labels(*values, reason)
        self._failed = counter("lightpage_bulk_ranges_failed", "Ranges without a result; files that cannot be opened.")
        self._died = counter("lightpage_bulk_workers_died", "Workers that died.")
        self._read_bytes = counter("lightpage_bulk_read_bytes", "Frames, as they lie in recordings.")
        self._job_pages = gauge("lightpage_bulk_job_pages", "Pages or devices of the job, or of this part of it.")
        self._left = gauge("lightpage_bulk_job_pages_left", "Pages or devices yet to be read, or read again.")
        self._in_flight = gauge("lightpage_bulk_ranges_in_flight", "Page ranges that workers are reading.")
        self._workers = gauge("lightpage_bulk_workers", "Workers alive; with Ray, as many as its CPUs suffice for.")
        self._ended = Gauge("lightpage_bulk_end_timestamp_seconds", "End of the run, in Unix time.", one, registry=own)
        info = Gauge("lightpage_bulk_info", "1 for what the run does.", [*one, "operation"], registry=own)
        info.labels(*values, operation).set(1)
        seconds = Histogram("lightpage_bulk_page_seconds", "Mean time for a page.", one, buckets=_SECONDS, registry=own)
        self._page_seconds = seconds.labels(*values)

    def wanted(self, total: int, left: int) -> None:
        """Note how many pages the job has, or devices, and how many have no result."""
        self._job_pages.set(total)
        self._left.set(left)

    def begin(self, engine: Engine) -> None:
        """Show how many workers there are and what they have, whenever somebody looks."""
        self._in_flight.set_function(lambda: engine.in_flight)
        self._workers.set_function(lambda: engine.workers_alive)

    def fail(self) -> None:
        """Count what has no result."""
        self._failed.inc()

    def deaths(self, count: int) -> None:
        """Count workers that died."""
        self._died.inc(count)

    def count(self, outcome: Outcome) -> None:
        """Count what became of a range."""
        if isinstance(outcome, Failed):
            self.fail()
            return
        pages, lost = outcome.task.weight, sum(outcome.lost.values())
        read = pages - lost - outcome.left_out
        for state, count in ((PageState.READ, read), (PageState.LOST, lost), (PageState.LEFT_OUT, outcome.left_out)):
            self._pages.labels(*self._own, state).inc(count)
        for reason, count in outcome.lost.items():
            self._lost.labels(*self._own, reason).inc(count)
        self._read_bytes.inc(outcome.read_bytes)
        self._left.dec(pages)
        for _ in range(pages):
            self._page_seconds.observe(outcome.seconds / pages)

    def end(self) -> None:
        """Note when the run ended."""
        self._ended.labels(*self._own).set(time.time())

    def write(self, path: Path) -> None:
        """Write all of it in the format of Prometheus, whole or not at all.

        Raises:
            InvalidInputError: it cannot be written.
        """
        replace_text(path, generate_latest(self.registry).decode(), "metrics")
