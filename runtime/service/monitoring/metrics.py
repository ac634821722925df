"""Metrics of the service: counters and gauges in the Prometheus format, one registry per service."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
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
    """Figures of one service.

    Gauges of the last page show the device: where the service has a source, frames of callers do not set them.
    """

    def __init__(self) -> None:
        self.registry = own = CollectorRegistry()
        ProcessCollector(registry=own)
        PlatformCollector(registry=own)
        GCCollector(registry=own)
        self._versions: list[str] = []
        self._naming = threading.Lock()
        """Held while `_versions` and the labels of `pages` are read or changed."""
        counter, gauge = partial(Counter, registry=own), partial(Gauge, registry=own)
        self.calls = counter("lightpage_calls", "Finished calls, by their gRPC status.", ["method", "code"])
        self.in_flight = gauge("lightpage_calls_in_flight", "Calls being served.")
        self.call_seconds = Histogram(
            "lightpage_call_seconds",
            "Time of whole calls, except those that only watch.",
            ["method"],
            buckets=(*_FINE_SECONDS, 300.0),
            registry=own,
        )
        self.stage_seconds = Histogram(
            "lightpage_stage_seconds",
            "Time of pages in each stage of their way through calls.",
            ["method", "stage"],
            buckets=_FINE_SECONDS,
            registry=own,
        )
        self.rejects = counter("lightpage_rejects", "Calls and pages that ended with an error.", ["reason"])
        self.pages = counter("lightpage_pages", "Decoded and confirmed pages of the newest models.", ["model_version"])
        self.steps = counter("lightpage_steps", "Gauss-Newton steps of pages, taken or skipped.", ["outcome"])
        self.decode = Histogram("lightpage_decode_seconds", "Decode of a page.", buckets=_SECONDS, registry=own)
        self.confidence = gauge("lightpage_confidence_mean", "Mean confidence of the last confirmed page.")
        self.concentration = gauge("lightpage_concentration_mean", "Mean von Mises kappa of the last confirmed page.")
        self.piston = gauge("lightpage_piston_radians", "Piston of the last confirmed page.")
        self.pilots = gauge("lightpage_pilot_coherence", "Agreement of the last page's pilots on the piston, 0 to 1.")
        self.trust = gauge("lightpage_pilot_trust", "Claimed concentration that the last page's pilots confirm.")
        self.share = gauge("lightpage_pilot_share", "Claimed information that the last page's pilots confirm.")
        self.due = gauge("lightpage_recalibration_due", "1 if the last page asks for a recalibration, else 0.")
        self.lost_pages = counter("lightpage_pages_lost", "Lost pages, by reason.", ["reason"])
        self.margin = gauge("lightpage_margin_bits", "Information of a symbol beyond what the page's code needs, bits.")
        self.data_pages = counter("lightpage_data_pages", "Pages read for user bytes, by their loss or none.", ["loss"])
        self.corrected = counter("lightpage_corrected_symbols", "Symbols of user bytes that Reed-Solomon corrected.")
        self.code_iterations = gauge("lightpage_code_iterations", "Iterations of the last page's code, mean of blocks.")
        self.searches = counter("lightpage_image_searches", "Searches for the image of a page, by result.", ["found"])
        self.image = gauge("lightpage_image_shift_px", "Shift of the last page's image since calibration.", ["axis"])
        self.recalibrations = counter("lightpage_recalibrations", "Recalibrations, by how they ended.", ["result"])
        self.monitor_due = gauge("lightpage_monitor_due", "1 if many pages together ask for a recalibration, else 0.")
        self.monitor_signs = gauge("lightpage_monitor_sign", "Signs of the monitor, smoothed over pages.", ["sign"])
        self.monitor_raised = gauge("lightpage_monitor_sign_raised", "1 if the sign is raised, else 0.", ["sign"])
        self.sessions_due = gauge("lightpage_sessions_due", "Sessions of callers that ask for a recalibration.")
        self.flight_pages = counter("lightpage_flight_pages", "Pages of the flight recorder, by result.", ["result"])
        self.model = gauge("lightpage_model_info", "1 for the model in service.", ["version"])
        self._begin_at_zero()

    def _begin_at_zero(self) -> None:
        """Show what may happen before it does: Prometheus sees no rise from nothing to the first one."""
        known: tuple[tuple[Counter, Iterable[str]], ...] = (
            (self.rejects, (name.removeprefix("ERROR_REASON_") for name in pb.ErrorReason.keys()[1:])),
            (self.steps, ("taken", "skipped")),
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
        self.decode.observe(page.timings.worked_s)
        self.steps.labels("taken").inc(page.timings.steps)
        self.steps.labels("skipped").inc(page.timings.skipped_steps)
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
        """Count a page of user bytes; `shown`: set the last-page gauges by it."""
        self.data_pages.labels(_READ if found.loss is None else found.loss.value).inc()
        self.corrected.inc(found.corrected)
        if shown:
            self.margin.set(found.margin_bits)
            self.code_iterations.set(found.iterations)

    def lost(self, error: LostPageError, *, tells: bool = True) -> None:
        """Count a lost page; where it `tells` of the device, set the gauges of drift by it."""
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

    def watch_steps(self, usual_s: Callable[[], Sequence[float]]) -> None:
        """Show the usual time of a page's inference by its number of steps, whenever somebody looks."""
        self.registry.register(_Figures(partial(_steps, usual_s)))

    def watch_batches(self, pages: UnderWay, largest: Callable[[], int]) -> None:
        """Show how full batches are, and what the device does that computes them, whenever somebody looks."""
        self.registry.register(_Figures(partial(_batches, pages, largest)))

    def watch(self, source: FrameSource) -> None:
        """Show what the source counts, whenever somebody looks."""
        self.registry.register(_Figures(partial(_source, source)))

    def watch_store(self, health: StoreHealth, trouble: Callable[[], Trouble | None]) -> None:
        """Show whether the store is well, and else its `trouble`, as far as it is known; whenever somebody looks."""
        self.registry.register(_Figures(partial(_store, health, trouble)))

    def watch_certificates(self, ends_s: Callable[[], float]) -> None:
        """Show when the first certificate ends, whenever somebody looks."""
        own = self.registry
        ends = Gauge("lightpage_certificate_ends_seconds", "First end of a certificate, Unix time.", registry=own)
        ends.set_function(ends_s)

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
    yield GaugeMetricFamily("lightpage_receive_buffer_bytes", "Undecoded frames of callers.", value=received.used)
    yield GaugeMetricFamily("lightpage_receive_buffer_limit_bytes", "Limit of undecoded frames.", value=received.size)


def _steps(usual_s: Callable[[], Sequence[float]]) -> Iterator[Metric]:
    """Yield the usual time of a page's inference with 1, 2, ... steps."""
    usual = GaugeMetricFamily("lightpage_steps_seconds", "Usual inference with so many steps.", labels=["steps"])
    for steps, seconds in enumerate(usual_s(), 1):
        usual.add_metric([str(steps)], seconds)
    yield usual


def _batches(pages: UnderWay, largest: Callable[[], int]) -> Iterator[Metric]:
    """Yield how full batches are, and what the device does that computes them."""
    runs = pages.runs.copy()
    bounds = {**{str(bound): bound for bound in _BATCH_PAGES}, "+Inf": math.inf}
    buckets = [(told, sum(runs[size] for size in runs if size <= bound)) for told, bound in bounds.items()]
    total = sum(size * count for size, count in runs.items())
    yield HistogramMetricFamily("lightpage_batch_pages", "Pages of a batch.", buckets=buckets, sum_value=total)
    yield GaugeMetricFamily("lightpage_batch_largest", "Pages of a batch, at most, as memory allows.", value=largest())
    yield CounterMetricFamily("lightpage_pages_alone", "Pages computed by themselves in place of a batch.", pages.alone)
    spent = CounterMetricFamily("lightpage_device_seconds", "What computes batches, by state.", labels=["state"])
    for state, seconds in pages.seconds().items():
        spent.add_metric([state.value], seconds)
    yield spent


def _source(source: FrameSource) -> Iterator[Metric]:
    """Return what a source counts by itself."""
    shots = CounterMetricFamily("lightpage_shots", "Shots, TAKEN or by why they were lost.", labels=["outcome"])
    for outcome, count in source.shots_by_outcome().items():
        shots.add_metric([outcome], count)
    yield shots
    share = GaugeMetricFamily("lightpage_saturated_share", "Pixels at full scale, last frame.", labels=["camera"])
    for camera, value in source.saturated_shares().items():
        share.add_metric([camera], value)
    yield share
    is_well = float(not source.trouble())
    yield GaugeMetricFamily("lightpage_source_ok", "1 if pages of the source can be read, else 0.", value=is_well)


def _store(health: StoreHealth, trouble: Callable[[], Trouble | None]) -> Iterator[Metric]:
    """Return how the store is; a disk that hangs is waited for no longer than `_LOOK_S`."""
    is_well, found = health.is_well(_LOOK_S), None
    if not is_well and health.hangs:
        found = Reason.HUNG
    elif not is_well and (known := trouble()) is not None:
        found = known.reason
    yield GaugeMetricFamily("lightpage_store_ok", "1 if the model store is well, else 0.", value=float(is_well))
    reasons = GaugeMetricFamily("lightpage_store_trouble", "1 for what is wrong with the store.", labels=["reason"])
    for reason in Reason:
        reasons.add_metric([reason.value], float(reason is found))
    yield reasons
