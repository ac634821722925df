"""Traces of calls for whoever collects them by OTLP: a span of each call, and within it one of each stage.

OpenTelemetry is an extra, and is imported only where somebody has named an endpoint. Spans are made when a call has
ended, from what was timed anyway; another thread sends them. Where nobody takes them, they are dropped.
"""

import logging
import threading
import time
from collections.abc import Iterable, Mapping
from importlib.metadata import version as installed_version
from typing import Any, Self
from urllib.parse import urlsplit

import grpc

from lightpage.errors import InvalidInputError
from lightpage.runtime.service.caller import Call
from lightpage.runtime.service.monitoring.logs import MOST_TEXT
from lightpage.runtime.service.stages import Lap

MOST_PAGES = 64
"""Pages of a call that have spans, the first ones: a range may have thousands."""
_QUEUED_SPANS = 2048
"""Spans that wait to be sent, a few kB each, since texts of a caller are cut; further ones are dropped."""
_SEND_S = 5.0
"""For a batch of spans, tries again included."""
_END_S = 1.0
"""At a stop, for what waits to be sent."""
_FAULTS = frozenset(
    [
        grpc.StatusCode.UNKNOWN,
        grpc.StatusCode.DEADLINE_EXCEEDED,
        grpc.StatusCode.UNIMPLEMENTED,
        grpc.StatusCode.INTERNAL,
        grpc.StatusCode.UNAVAILABLE,
        grpc.StatusCode.DATA_LOSS,
    ]
)
"""Statuses that make a server's span an error, by OpenTelemetry's conventions for RPC."""

_log = logging.getLogger(__name__)


class Traces:
    """Sends spans to an endpoint; use it in a `with` statement.

    At the end it sends what waits, for a limited time.

    Args:
        endpoint: http://HOST:PORT or https://HOST:PORT of a collector that takes OTLP over gRPC.
        share: of the calls that are traced, 0..1. A caller that has decided for its own trace has decided for this too.

    Raises:
        InvalidInputError: the extra `traces` is not installed, or the endpoint is no such address.
    """

    def __init__(self, endpoint: str, share: float = 1.0) -> None:
        try:
            from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter
            from opentelemetry.sdk.resources import Resource
            from opentelemetry.sdk.trace import TracerProvider
            from opentelemetry.sdk.trace.export import BatchSpanProcessor
            from opentelemetry.sdk.trace.sampling import ParentBased, TraceIdRatioBased
            from opentelemetry.trace import SpanKind, Status, StatusCode, set_span_in_context
            from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator
        except ImportError as error:
            expected = "the extra `traces`: pip install 'lightpage[traces]'"
            raise InvalidInputError("traces.endpoint", f"{endpoint}, but {error}", expected) from None
        check_endpoint(endpoint)
        version = installed_version("lightpage")
        about = Resource.create({"service.name": "lightpage", "service.version": version})
        self._exporter = OTLPSpanExporter(endpoint, endpoint.startswith("http://"), timeout=_SEND_S)
        self._provider = TracerProvider(ParentBased(TraceIdRatioBased(share)), about, shutdown_on_exit=False)
        self._provider.add_span_processor(BatchSpanProcessor(self._exporter, max_queue_size=_QUEUED_SPANS))
        self._tracer = self._provider.get_tracer("lightpage", version)
        self._propagator = TraceContextTextMapPropagator()
        self._server, self._inside = SpanKind.SERVER, set_span_in_context
        self._status, self._error = Status, StatusCode.ERROR

    def ended(
        self, call: Call, service: str, headers: Mapping[str, Any], code: grpc.StatusCode, reason: str, ended: float
    ) -> None:
        """Make the spans of a call that has ended.

        Args:
            call: call whose `times` are those of its pages.
            service: full name of its service.
            headers: headers of the call; `traceparent` names the span of its caller.
            code: its status.
            reason: reason of an error, as callers read it, else empty.
            ended: when it has, `time.perf_counter` seconds.
        """
        try:
            method, times = call.method.rpartition("/")[2], call.times
            before = time.time_ns() - round(1e9 * time.perf_counter())
            parent = self._propagator.extract({key: value for key, value in headers.items() if isinstance(value, str)})
            attributes: dict[str, Any] = {
                "rpc.system": "grpc",
                "rpc.service": service,
                "rpc.method": method,
                "rpc.grpc.status_code": code.value[0],
                "lightpage.peer": call.peer,
                "lightpage.pages": times.count,
            }
            named = {"lightpage.correlation_id": call.correlation_id, "lightpage.reason": reason}
            attributes |= {name: text[:MOST_TEXT] for name, text in named.items() if text}

            def at(seconds: float) -> int:
                return before + round(1e9 * seconds)

            def laps(within: Any, laps: Iterable[Lap]) -> None:
                for lap in laps:
                    self._tracer.start_span(lap.stage.value, within, start_time=at(lap.start)).end(at(lap.end))

            name, begun = f"{service}/{method}", at(call.begun)
            span = self._tracer.start_span(name, parent, self._server, attributes, start_time=begun)
            if code in _FAULTS:
                span.set_status(self._status(self._error, code.name))
            if span.is_recording():
                inside = self._inside(span)
                for page in times.pages:
                    if times.count == 1:
                        laps(inside, page.laps)
                    else:
                        own = self._tracer.start_span("page", inside, start_time=at(page.start))
                        laps(self._inside(own), page.laps)
                        own.end(at(page.start + page.elapsed_s))
            span.end(at(ended))
        except Exception:  # whatever becomes of its trace, a call has its answer
            _log.exception("no trace of %s", call.method)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Send what waits, for a limited time."""
        ending = threading.Thread(target=self._provider.shutdown, name="lightpage-traces", daemon=True)
        ending.start()
        ending.join(_END_S)
        if ending.is_alive():
            self._exporter.shutdown()  # whoever still tries gives up
            ending.join(_END_S)


def check_endpoint(endpoint: str) -> str:
    """The address of a collector, if it is one.

    Raises:
        InvalidInputError: it is none.
    """
    try:
        parts = urlsplit(endpoint)
        right = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port is not None
        right = right and parts.path in ("", "/") and not parts.query and not parts.fragment and parts.username is None
    except ValueError:
        right = False
    if not right:
        raise InvalidInputError("traces.endpoint", endpoint, "http://HOST:PORT or https://HOST:PORT")
    return endpoint
