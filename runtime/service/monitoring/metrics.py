"""Metrics of the service: counters and gauges in the Prometheus format, one registry per service."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    GCCollector,
    Histogram,
    PlatformCollector,
    ProcessCollector,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from lightpage.codec.page_bytes import Loss, PageBytes
from lightpage.errors import LostPageError, UnconfirmedPageError
from lightpage.errors import Reason as PageLoss
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.acquisition.source import FrameSource
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import unconfirmed_page
from lightpage.runtime.model.decoding.under_way import UnderWay
from lightpage.runtime.service.models.store_health import Reason, StoreHealth, Trouble

if TYPE_CHECKING:
    from lightpage.runtime.service.admission import ReceiveBudget, Slots
    from lightpage.runtime.service.stages import Stages

_SECONDS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_FINE_SECONDS = tuple(sorted({*_SECONDS, 0.001, 0.002, 0.03, 0.07, 0.15, 0.3, 0.7, 1.5, 3.0, 7.0, 20.0, 60.0}))
"""From handing over a small reply to the longest wait for a slot; no bucket is much wider than the time in it."""
_BATCH_PAGES = (1, 2, 4, 8, 16, 32, 64)
_READ = "none"
"""Loss of a page whose bytes were read."""
_LOOK_S = 2.0
"""A scrape waits so long for the store's disk: less than Prometheus waits for a scrape."""
VERSIONS = 32
"""Models whose pages are told apart, the newest: each recalibration makes another one."""


class ServiceMetrics:
    """The figures of one service."""

    def __init__(self) -> None:
        self.registry = own = CollectorRegistry()
        ProcessCollector(registry=own)
        PlatformCollector(registry=own)
        GCCollector(registry=own)
        self._versions: list[str] = []
        self._naming = threading.Lock()
        """Held while `_versions` and the labels of `pages` are read or changed."""
        self.calls = Counter("lightpage_calls", "Finished calls.", ["method", "code"], registry=own)
        self.in_flight = Gauge("lightpage_calls_in_flight", "Calls being served.", registry=own)
        self.call_seconds = Histogram(
            "lightpage_call_seconds",
            "Whole calls, watches left out.",
            ["method"],
            buckets=(*_FINE_SECONDS, 300.0),
            registry=own,
        )
        self.stage_seconds = Histogram(
            "lightpage_stage_seconds",
            "Stages of pages on their way through calls.",
            ["method", "stage"],
            buckets=_FINE_SECONDS,
            registry=own,
        )
        self.rejects = Counter("lightpage_rejects", "Calls and pages refused, by reason.", ["reason"], registry=own)
        self.pages = Counter("lightpage_pages", "Decoded pages.", ["model_version"], registry=own)
        self.decode = Histogram("lightpage_decode_seconds", "Decode of one page.", buckets=_SECONDS, registry=own)
        self.confidence = Gauge("lightpage_confidence_mean", "Mean confidence of the last page.", registry=own)
        self.concentration = Gauge("lightpage_concentration_mean", "Mean kappa of the last page.", registry=own)
        self.piston = Gauge("lightpage_piston_radians", "Piston of the last page.", registry=own)
        self.pilots = Gauge("lightpage_pilot_coherence", "Agreement of the last pilots, 0..1.", registry=own)
        self.trust = Gauge("lightpage_pilot_trust", "Claim that the last pilots bear out, 0..1.", registry=own)
        self.share = Gauge("lightpage_pilot_share", "Claimed information that the last pilots confirm.", registry=own)
        self.due = Gauge("lightpage_recalibration_due", "1 where they confirm too little of it.", registry=own)
        self.lost_pages = Counter("lightpage_pages_lost", "Pages not given out.", ["reason"], registry=own)
        self.margin = Gauge("lightpage_margin_bits", "Of the last page beyond what its code needs.", registry=own)
        self.data_pages = Counter("lightpage_data_pages", "Pages read for their bytes.", ["loss"], registry=own)
        self.corrected = Counter("lightpage_corrected_symbols", "Mended by Reed-Solomon.", registry=own)
        self.code_iterations = Gauge("lightpage_code_iterations", "Of the last page's blocks, mean.", registry=own)
        self.searches = Counter("lightpage_image_searches", "Pages searched for.", ["found"], registry=own)
        self.image = Gauge("lightpage_image_shift_px", "Of the last page since calibration.", ["axis"], registry=own)
        self.recalibrations = Counter("lightpage_recalibrations", "By their end.", ["result"], registry=own)
        self.monitor_due = Gauge("lightpage_monitor_due", "1 where many pages say so.", registry=own)
        self.monitor_signs = Gauge("lightpage_monitor_sign", "Smoothed over pages.", ["sign"], registry=own)
        self.monitor_raised = Gauge("lightpage_monitor_sign_raised", "1 where beyond it.", ["sign"], registry=own)
        self.sessions_due = Gauge("lightpage_sessions_due", "Callers' sessions that say so.", registry=own)
        self.flight_pages = Counter("lightpage_flight_pages", "Kept, dropped or failed.", ["result"], registry=own)
        self.model = Gauge("lightpage_model_info", "1 for the model in service.", ["version"], registry=own)
        self._begin_at_zero()

    def _begin_at_zero(self) -> None:
        """Show what may happen before it does: Prometheus sees no rise from nothing to the first one."""
        known: tuple[tuple[Counter, Iterable[str]], ...] = (
            (self.rejects, (name.removeprefix("ERROR_REASON_") for name in pb.ErrorReason.keys()[1:])),
            (self.lost_pages, (reason.value for reason in PageLoss)),
            (self.data_pages, (_READ, *(loss.value for loss in Loss))),
            (self.searches, ("true", "false")),
            (self.recalibrations, ("done", "refused", "failed", "dropped")),
            (self.flight_pages, ("kept", "dropped", "failed")),
        )
        for counter, values in known:
            for value in values:
                counter.labels(value)

    def call_ended(self, method: str, code: str, reason: str, seconds: float | None) -> None:
        """Count a call by its status; `reason` is empty where it ended well, `seconds` None of a watch."""
        self.calls.labels(method, code).inc()
        self.rejected(reason)
        if seconds is not None:
            self.call_seconds.labels(method).observe(seconds)

    def rejected(self, reason: str) -> None:
        """Count what was refused, if it was."""
        if reason:
            self.rejects.labels(reason).inc()

    def timed(self, method: str, stages: Stages) -> None:
        """Count where the time of a page went."""
        for stage, seconds in stages.seconds().items():
            self.stage_seconds.labels(method, stage.value).observe(seconds)

    def page(self, page: DecodedPage, version: str, *, shown: bool = True) -> None:
        """Count one decoded page, and have it `shown` as the last one.

        A page of a model whose label was removed does not bring it back.
        """
        with self._naming:
            if version in self._versions:
                self.pages.labels(version).inc()
        self.decode.observe(page.timings.total_s)
        if not shown:
            return
        self.confidence.set(float(page.confidence.mean()))
        self.concentration.set(float(page.concentration.mean()))
        self.piston.set(page.piston_rad)
        self.pilots.set(page.pilot_coherence)
        self.trust.set(page.pilot_trust)
        self._check(page)
        if page.image is not None:
            self.image.labels("x").set(page.image.shift_x_px)
            self.image.labels("y").set(page.image.shift_y_px)

    def user_data(self, found: PageBytes, *, shown: bool = True) -> None:
        """Count a page whose bytes were read, or not, and have it `shown` as the last one."""
        self.data_pages.labels(_READ if found.loss is None else found.loss.value).inc()
        self.corrected.inc(found.corrected)
        if shown:
            self.margin.set(found.margin_bits)
            self.code_iterations.set(found.iterations)

    def lost(self, error: LostPageError, *, tells: bool = True) -> None:
        """Count a page that was not given out; where it `tells` of the device, that is a sign of drift too."""
        self.lost_pages.labels(error.reason.value).inc()
        if tells and isinstance(error, UnconfirmedPageError):
            self._check(unconfirmed_page(error))

    def _check(self, page: DecodedPage) -> None:
        self.share.set(page.check.share)
        self.due.set(page.check.recalibration_due)
        if page.image is not None and page.image.searched:
            self.searches.labels(str(page.image.found).lower()).inc()

    def watch_load(self, decodes: Slots, received: ReceiveBudget) -> None:
        """Show how busy the service is, whenever somebody looks."""
        self.registry.register(_Figures(partial(_load, decodes, received)))

    def watch_batches(self, pages: UnderWay) -> None:
        """Show how full batches are, and what the device does that computes them, whenever somebody looks."""
        self.registry.register(_Figures(partial(_batches, pages)))

    def watch(self, source: FrameSource) -> None:
        """Show what the source counts, whenever somebody looks."""
        self.registry.register(_Figures(partial(_source, source)))

    def watch_store(self, health: StoreHealth, trouble: Callable[[], Trouble | None]) -> None:
        """Show whether the store is well, and else its `trouble`, as far as it is known; whenever somebody looks."""
        self.registry.register(_Figures(partial(_store, health, trouble)))

    def watch_certificates(self, ends_s: Callable[[], float]) -> None:
        """Show when the first certificate ends, whenever somebody looks."""
        name, about = "lightpage_certificate_ends_seconds", "First end of its own and its authorities', since 1970."
        Gauge(name, about, registry=self.registry).set_function(ends_s)

    def in_service(self, version: str) -> None:
        """Say which model decodes now."""
        self.model.clear()
        self.model.labels(version).set(1)
        with self._naming:
            self.pages.labels(version)
            self._versions = [*(known for known in self._versions if known != version), version]
            for old in self._versions[:-VERSIONS]:
                self.pages.remove(old)
            self._versions = self._versions[-VERSIONS:]


class _Figures(Collector):
    """Figures that are counted elsewhere and read at each scrape."""

    def __init__(self, look: Callable[[], Iterator[Metric]]) -> None:
        self._look = look

    def collect(self) -> Iterator[Metric]:
        """The figures as they are now."""
        return self._look()


def _load(decodes: Slots, received: ReceiveBudget) -> Iterator[Metric]:
    """Return how busy the service is."""
    yield GaugeMetricFamily("lightpage_decodes_waiting", "Pages that wait for a slot.", value=decodes.queued)
    yield GaugeMetricFamily("lightpage_decodes_busy", "Slots in which a page is decoded.", value=decodes.busy)
    yield GaugeMetricFamily("lightpage_decodes_slots", "Pages decoded at once, at most.", value=decodes.count)
    yield CounterMetricFamily("lightpage_received_bytes", "Frames that callers sent.", value=received.taken)
    yield GaugeMetricFamily("lightpage_receive_buffer_bytes", "Of them not yet decoded.", value=received.used)
    yield GaugeMetricFamily("lightpage_receive_buffer_limit_bytes", "At most so many.", value=received.size)


def _batches(pages: UnderWay) -> Iterator[Metric]:
    """Yield how full batches are, and what the device does that computes them."""
    runs = pages.runs.copy()
    bounds = {**{str(bound): bound for bound in _BATCH_PAGES}, "+Inf": math.inf}
    buckets = [(told, sum(runs[size] for size in runs if size <= bound)) for told, bound in bounds.items()]
    about, total = "Pages of a batch.", sum(size * count for size, count in runs.items())
    yield HistogramMetricFamily("lightpage_batch_pages", about, buckets=buckets, sum_value=total)
    spent = CounterMetricFamily("lightpage_device_seconds", "What computes batches, by what it did.", labels=["state"])
    for state, seconds in pages.seconds().items():
        spent.add_metric([state.value], seconds)
    yield spent


def _source(source: FrameSource) -> Iterator[Metric]:
    """Return what a source counts by itself."""
    shots = CounterMetricFamily("lightpage_shots", "Shots of the cameras, by how they ended.", labels=["outcome"])
    for outcome, count in source.shots_by_outcome().items():
        shots.add_metric([outcome], count)
    yield shots
    share = GaugeMetricFamily("lightpage_saturated_share", "Pixels at full scale, last frame.", labels=["camera"])
    for camera, value in source.saturated_shares().items():
        share.add_metric([camera], value)
    yield share
    about = "1 where pages of the source can be read, 0 where a beam may be blocked."
    yield GaugeMetricFamily("lightpage_source_ok", about, value=float(not source.trouble()))


def _store(health: StoreHealth, trouble: Callable[[], Trouble | None]) -> Iterator[Metric]:
    """Return how the store is; a disk that hangs is waited for no longer than `_LOOK_S`."""
    is_well, found = health.is_well(_LOOK_S), None
    if not is_well and health.hangs:
        found = Reason.HUNG
    elif not is_well and (known := trouble()) is not None:
        found = known.reason
    yield GaugeMetricFamily("lightpage_store_ok", "1 where the model store is well.", value=float(is_well))
    reasons = GaugeMetricFamily("lightpage_store_trouble", "1 for what is wrong with it.", labels=["reason"])
    for reason in Reason:
        reasons.add_metric([reason.value], float(reason is found))
    yield reasons
