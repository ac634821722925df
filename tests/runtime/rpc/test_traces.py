"""A real receiver of OTLP gets the spans of calls; one that is not there costs nobody a page."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import grpc
import pytest
from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2, trace_service_pb2_grpc
from opentelemetry.proto.trace.v1.trace_pb2 import Span, Status

from lightpage.errors import InvalidInputError
from runtime.decoding.decoder import Decoder
from runtime.pb.inference import open_inference_pb2 as oip
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.rpc.inference_calls import INFERENCE
from runtime.service.logs import MOST_TEXT
from runtime.service.traces import MOST_PAGES, Traces
from tests.runtime.rpc.conftest import begun
from tests.runtime.rpc.stage import Running, a_page, parts, refused
from tests.runtime.rpc.test_inference import stub_of

TRACE, CALLER = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
SAMPLED, UNSAMPLED = (f"00-{TRACE}-{CALLER}-0{flag}" for flag in (1, 0))


class Receiver(trace_service_pb2_grpc.TraceServiceServicer):
    """Keeps the spans that come."""

    def __init__(self) -> None:
        self.spans: list[Span] = []
        self.services: set[str] = set()

    def Export(self, request: Any, context: Any) -> Any:
        for resource in request.resource_spans:
            named = {each.key: each.value.string_value for each in resource.resource.attributes}
            self.services.add(named["service.name"])
            for scope in resource.scope_spans:
                self.spans += scope.spans
        return trace_service_pb2.ExportTraceServiceResponse()


@contextmanager
def receiving() -> Iterator[tuple[Receiver, str]]:
    receiver, server = Receiver(), grpc.server(ThreadPoolExecutor(2))
    trace_service_pb2_grpc.add_TraceServiceServicer_to_server(receiver, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield receiver, f"http://127.0.0.1:{port}"
    server.stop(0).wait()


@contextmanager
def traced(decoder: Decoder, endpoint: str, share: float = 1.0) -> Iterator[Running]:
    """A service whose spans have been sent once the block has ended."""
    with Traces(endpoint, share) as traces:
        service = begun(decoder, traces=traces)
        yield service
        service.end()


def attributes(span: Span) -> dict[str, Any]:
    return {each.key: getattr(each.value, each.value.WhichOneof("value")) for each in span.attributes}


def inside(spans: list[Span], parent: Span) -> list[Span]:
    return sorted(
        (one for one in spans if one.parent_span_id == parent.span_id), key=lambda one: one.start_time_unix_nano
    )


def test_a_decode_is_a_span_with_its_stages_within_its_callers_trace(decoder: Decoder) -> None:
    with receiving() as (receiver, endpoint), traced(decoder, endpoint) as service:
        header = (("traceparent", SAMPLED),)
        service.stub.DecodeFrames(parts(a_page()[1], correlation_id="order-7"), timeout=20, metadata=header)
        refused(lambda: service.stub.GetJob(pb.GetJobRequest(id="none"), timeout=20))
        stub_of(service).ServerLive(oip.ServerLiveRequest(), timeout=20)
    call = next(span for span in receiver.spans if span.name == "lightpage.v1.Lightpage/DecodeFrames")
    assert receiver.services == {"lightpage"}
    assert (call.trace_id.hex(), call.parent_span_id.hex()) == (TRACE, CALLER)
    assert (call.kind, call.status.code) == (Span.SPAN_KIND_SERVER, Status.STATUS_CODE_UNSET)
    told = attributes(call)
    assert (told["rpc.system"], told["rpc.service"], told["rpc.method"]) == (
        "grpc",
        "lightpage.v1.Lightpage",
        "DecodeFrames",
    )
    assert (told["rpc.grpc.status_code"], told["lightpage.correlation_id"]) == (0, "order-7")
    stages = inside(receiver.spans, call)
    assert [one.name for one in stages] == ["receive", "queue", "inference", "post_processing", "respond"]
    assert {one.trace_id.hex() for one in stages} == {TRACE}
    assert 1.7e18 < call.start_time_unix_nano < call.end_time_unix_nano  # of the epoch
    assert stages[0].start_time_unix_nano == call.start_time_unix_nano
    assert stages[-1].end_time_unix_nano == call.end_time_unix_nano
    for one, following in pairwise(stages):
        assert one.end_time_unix_nano == following.start_time_unix_nano
    failed = next(span for span in receiver.spans if span.name.endswith("/GetJob"))
    assert failed.parent_span_id == b""
    assert attributes(failed)["lightpage.reason"] == "NO_SUCH_JOB"
    assert attributes(failed)["rpc.grpc.status_code"] == grpc.StatusCode.NOT_FOUND.value[0]
    assert inside(receiver.spans, failed) == []
    live = next(span for span in receiver.spans if span.name == f"{INFERENCE.full_name}/ServerLive")
    assert (attributes(live)["rpc.service"], attributes(live)["rpc.method"]) == (INFERENCE.full_name, "ServerLive")


def test_a_callers_text_is_cut_before_it_waits_to_be_sent(decoder: Decoder, caplog: pytest.LogCaptureFixture) -> None:
    with receiving() as (receiver, endpoint), traced(decoder, endpoint) as service:
        service.stub.ReadPage(pb.ReadPageRequest(correlation_id=2 * MOST_TEXT * "a"), timeout=20)
    [call] = (span for span in receiver.spans if span.kind == Span.SPAN_KIND_SERVER)
    assert attributes(call)["lightpage.correlation_id"] == MOST_TEXT * "a"
    assert "truncating" not in caplog.text  # a line of the library's for each call


def test_a_call_of_many_pages_has_a_span_of_each_up_to_a_number(decoder: Decoder) -> None:
    count = MOST_PAGES + 2
    with receiving() as (receiver, endpoint), traced(decoder, endpoint) as service:
        assert len(list(service.stub.ReadPages(pb.ReadPagesRequest(count=count), timeout=60))) == count
    call = next(span for span in receiver.spans if span.name.endswith("/ReadPages"))
    assert attributes(call)["lightpage.pages"] == count
    pages = inside(receiver.spans, call)
    assert [one.name for one in pages] == ["page"] * MOST_PAGES
    for page in pages:
        names = [one.name for one in inside(receiver.spans, page)]
        assert names == ["queue", "receive", "inference", "post_processing", "respond"]


def test_a_caller_that_has_decided_for_its_trace_has_decided_for_its_calls(decoder: Decoder) -> None:
    with receiving() as (receiver, endpoint):
        for share, wanted in ((0.0, ["ReadPage"]), (1.0, ["Describe", "ReadPage"])):
            receiver.spans.clear()
            with traced(decoder, endpoint, share) as service:
                stub = service.stub
                stub.ReadPage(pb.ReadPageRequest(), timeout=20, metadata=(("traceparent", SAMPLED),))
                stub.ListModels(pb.ListModelsRequest(), timeout=20, metadata=(("traceparent", UNSAMPLED),))
                stub.Describe(pb.DescribeRequest(), timeout=20, metadata=(("traceparent", "nonsense"),))
            calls = {span.name.rpartition("/")[2] for span in receiver.spans if span.kind == Span.SPAN_KIND_SERVER}
            assert sorted(calls) == wanted


def test_where_nobody_takes_spans_no_page_is_lost_and_nothing_waits(
    decoder: Decoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # nobody listens there, and nobody else will
        endpoint = f"http://127.0.0.1:{taken.getsockname()[1]}"
        held, release = threading.Event(), threading.Event()
        export = OTLPSpanExporter.export

        def waits(exporter: OTLPSpanExporter, spans: Any) -> Any:
            held.set()
            release.wait(60)
            return export(exporter, spans)

        monkeypatch.setattr(OTLPSpanExporter, "export", waits)
        with Traces(endpoint) as traces:
            service = begun(decoder, traces=traces)
            count = 120  # makes more spans than a batch has
            assert len(list(service.client.read_pages(count=count))) == count
            assert all(service.client.read_page(1).page == 1 for _ in range(count))
            assert held.wait(60)
            assert all(service.client.read_page(1).page == 1 for _ in range(count))
            service.end()
            release.set()


def test_without_the_extra_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with pytest.raises(InvalidInputError) as error:
        Traces("http://127.0.0.1:4317")
    assert "lightpage[traces]" in error.value.expected
