"""What a bulk run shows to Prometheus: while it works to whoever scrapes, and after its end as a file."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.metrics import MetricWrapperBase

from lightpage.codec.page_bytes import Loss
from lightpage.errors import Reason
from lightpage.files import replace_text
from lightpage.runtime.archives.run.driver import Watch
from lightpage.runtime.archives.run.engine import Engine
from lightpage.runtime.archives.run.part import WHOLE, Part
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
        self._own = run, str(part)
        one = ["run", "part"]
        self.pages = Counter("lightpage_bulk_pages", "Pages, by what became of them.", [*one, "state"], registry=own)
        self.lost = Counter("lightpage_bulk_pages_lost", "Lost pages, by cause.", [*one, "reason"], registry=own)
        self.failed = Counter("lightpage_bulk_ranges_failed", "Ranges or files without a result.", one, registry=own)
        self.died = Counter("lightpage_bulk_workers_died", "Workers that died.", one, registry=own)
        self.read_bytes = Counter("lightpage_bulk_read_bytes", "Frames, as they lie in recordings.", one, registry=own)
        self.job_pages = Gauge("lightpage_bulk_job_pages", "Pages of the whole job, or devices.", one, registry=own)
        self.left = Gauge("lightpage_bulk_job_pages_left", "Those yet to be read, or read again.", one, registry=own)
        self.in_flight = Gauge("lightpage_bulk_ranges_in_flight", "Page ranges handed out.", one, registry=own)
        self.workers = Gauge("lightpage_bulk_workers", "Workers alive.", one, registry=own)
        self.ended = Gauge("lightpage_bulk_end_timestamp_seconds", "When the run ended.", one, registry=own)
        self.info = Gauge("lightpage_bulk_info", "1 for what the run does.", [*one, "operation"], registry=own)
        self.page_seconds = Histogram(
            "lightpage_bulk_page_seconds",
            "A worker's time for a page, mean of its range.",
            one,
            buckets=_SECONDS,
            registry=own,
        )
        self.info.labels(*self._own, operation).set(1)
        self._begin_at_zero(operation)

    def _begin_at_zero(self, operation: Operation) -> None:
        """Show what may happen before it does: Prometheus sees no rise from nothing to the first one."""
        known: tuple[tuple[MetricWrapperBase, Iterable[tuple[str, ...]]], ...] = (
            (self.pages, ((state,) for state in PageState)),
            (self.lost, ((reason,) for reason in _CAUSES.get(operation, ()))),
            *((metric, ((),)) for metric in (self.failed, self.died, self.read_bytes, self.page_seconds)),
            *((metric, ((),)) for metric in (self.job_pages, self.left, self.in_flight, self.workers)),
        )
        for metric, values in known:
            for value in values:
                metric.labels(*self._own, *value)

    def wanted(self, total: int, left: int) -> None:
        """Note how many pages the job has, or devices, and how many have no result."""
        self.job_pages.labels(*self._own).set(total)
        self.left.labels(*self._own).set(left)

    def begin(self, engine: Engine) -> None:
        """Show how many workers there are and what they have, whenever somebody looks."""
        self.in_flight.labels(*self._own).set_function(lambda: engine.in_flight)
        self.workers.labels(*self._own).set_function(lambda: engine.workers_alive)

    def fail(self) -> None:
        """Count what has no result."""
        self.failed.labels(*self._own).inc()

    def deaths(self, count: int) -> None:
        """Count workers that died."""
        self.died.labels(*self._own).inc(count)

    def count(self, outcome: Outcome) -> None:
        """Count what became of a range."""
        if isinstance(outcome, Failed):
            self.fail()
            return
        pages, lost = outcome.task.weight, sum(outcome.lost.values())
        read = pages - lost - outcome.left_out
        for state, count in ((PageState.READ, read), (PageState.LOST, lost), (PageState.LEFT_OUT, outcome.left_out)):
            self.pages.labels(*self._own, state).inc(count)
        for reason, count in outcome.lost.items():
            self.lost.labels(*self._own, reason).inc(count)
        self.read_bytes.labels(*self._own).inc(outcome.read_bytes)
        self.left.labels(*self._own).dec(pages)
        for _ in range(pages):
            self.page_seconds.labels(*self._own).observe(outcome.seconds / pages)

    def end(self) -> None:
        """Note when the run ended."""
        self.ended.labels(*self._own).set(time.time())

    def write(self, path: Path) -> None:
        """Write all of it in the format of Prometheus, whole or not at all.

        Raises:
            InvalidInputError: it cannot be written.
        """
        replace_text(path, generate_latest(self.registry).decode(), "metrics")
