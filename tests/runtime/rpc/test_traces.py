"""A real receiver of OTLP gets the spans of calls; one that is not there costs nobody a page."""

from __future__ import annotations

import socket
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import grpc
import pytest
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2, trace_service_pb2_grpc
from opentelemetry.proto.trace.v1.trace_pb2 import Span, Status

from lightpage.errors import InvalidInputError
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from runtime.pb.inference import open_inference_pb2 as oip
from runtime.pb.inference import open_inference_pb2_grpc as oip_grpc
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.inference_calls import INFERENCE
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.logs import MOST_TEXT
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.service.traces import MOST_PAGES, Traces
from tests.runtime import toy
from tests.runtime.rpc.stage import a_page
from tests.runtime.rpc.test_edge import parts

TRACE, CALLER = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"
SAMPLED, UNSAMPLED = (f"00-{TRACE}-{CALLER}-0{flag}" for flag in (1, 0))


Stubs = tuple[pb_grpc.LightpageStub, oip_grpc.GRPCInferenceServiceStub]


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
def traced(bundle: Path, endpoint: str, share: float = 1.0) -> Iterator[Stubs]:
    """A service whose spans have been sent once the block has ended."""
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(bundle), threads=1)), toy.ToySource(toy.ToyDevice()))
    with (
        Traces(endpoint, share) as traces,
        LightpageServer(plane, Recalibrator(plane, toy.fit_references), traces=traces) as server,
        grpc.insecure_channel(server.target) as channel,
    ):
        yield pb_grpc.LightpageStub(channel), oip_grpc.GRPCInferenceServiceStub(channel)


def attributes(span: Span) -> dict[str, Any]:
    return {each.key: getattr(each.value, each.value.WhichOneof("value")) for each in span.attributes}


def inside(spans: list[Span], parent: Span) -> list[Span]:
    return sorted(
        (one for one in spans if one.parent_span_id == parent.span_id), key=lambda one: one.start_time_unix_nano
    )


def test_a_decode_is_a_span_with_its_stages_within_its_callers_trace(toy_zip: Path) -> None:
    with receiving() as (receiver, endpoint):
        before = time.time_ns()
        with traced(toy_zip, endpoint) as (stub, other):
            header = (("traceparent", SAMPLED),)
            stub.DecodeFrames(parts(a_page()[1], correlation_id="order-7"), timeout=20, metadata=header)
            with pytest.raises(grpc.RpcError):
                stub.GetJob(pb.GetJobRequest(id="none"), timeout=20)
            other.ServerLive(oip.ServerLiveRequest(), timeout=20)
        after = time.time_ns()
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
    assert before <= call.start_time_unix_nano
    assert call.end_time_unix_nano <= after
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


def test_a_callers_text_is_cut_before_it_waits_to_be_sent(toy_zip: Path, caplog: pytest.LogCaptureFixture) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # nobody listens there
        with traced(toy_zip, f"http://127.0.0.1:{taken.getsockname()[1]}") as (stub, _):
            stub.ReadPage(pb.ReadPageRequest(correlation_id="a"), timeout=20)
            size, count = 2 << 20, 20
            tracemalloc.start()
            try:
                for _ in range(count):
                    stub.ReadPage(pb.ReadPageRequest(correlation_id=size * "a"), timeout=60)
                held, _ = tracemalloc.get_traced_memory()
            finally:
                tracemalloc.stop()
            assert held < count * size / 4
    with receiving() as (receiver, endpoint), traced(toy_zip, endpoint) as (stub, _):
        stub.ReadPage(pb.ReadPageRequest(correlation_id=2 * MOST_TEXT * "a"), timeout=20)
    [call] = (span for span in receiver.spans if span.kind == Span.SPAN_KIND_SERVER)
    assert attributes(call)["lightpage.correlation_id"] == MOST_TEXT * "a"
    assert "truncating" not in caplog.text  # a line of the library's for each call


def test_a_call_of_many_pages_has_a_span_of_each_up_to_a_number(toy_zip: Path) -> None:
    count = MOST_PAGES + 2
    with receiving() as (receiver, endpoint), traced(toy_zip, endpoint) as (stub, _):
        assert len(list(stub.ReadPages(pb.ReadPagesRequest(count=count), timeout=60))) == count
    call = next(span for span in receiver.spans if span.name.endswith("/ReadPages"))
    assert attributes(call)["lightpage.pages"] == count
    pages = inside(receiver.spans, call)
    assert [one.name for one in pages] == ["page"] * MOST_PAGES
    for page in pages:
        names = [one.name for one in inside(receiver.spans, page)]
        assert names == ["queue", "receive", "inference", "post_processing", "respond"]


def test_a_caller_that_has_decided_for_its_trace_has_decided_for_its_calls(toy_zip: Path) -> None:
    with receiving() as (receiver, endpoint):
        for share, wanted in ((0.0, ["ReadPage"]), (1.0, ["Describe", "ReadPage"])):
            receiver.spans.clear()
            with traced(toy_zip, endpoint, share) as (stub, _):
                stub.ReadPage(pb.ReadPageRequest(), timeout=20, metadata=(("traceparent", SAMPLED),))
                stub.ListModels(pb.ListModelsRequest(), timeout=20, metadata=(("traceparent", UNSAMPLED),))
                stub.Describe(pb.DescribeRequest(), timeout=20, metadata=(("traceparent", "nonsense"),))
            calls = {span.name.rpartition("/")[2] for span in receiver.spans if span.kind == Span.SPAN_KIND_SERVER}
            assert sorted(calls) == wanted


def test_where_nobody_takes_spans_no_page_is_lost_and_nothing_waits(toy_zip: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # nobody listens there, and nobody else will
        traces = Traces(f"http://127.0.0.1:{taken.getsockname()[1]}")
        held, release = threading.Event(), threading.Event()

        def export(*_: Any, export: Any = traces._exporter.export) -> Any:
            held.set()
            release.wait(20)
            return export(*_)

        traces._exporter.export = export
        plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)), toy.ToySource(toy.ToyDevice()))
        recalibrator = Recalibrator(plane, toy.fit_references)
        server = LightpageServer(plane, recalibrator, traces=traces)
        with server, grpc.insecure_channel(server.target) as channel:
            stub = pb_grpc.LightpageStub(channel)
            count = 120  # makes more spans than a batch has
            replies = list(stub.ReadPages(pb.ReadPagesRequest(count=count), timeout=60))
            replies += [stub.ReadPage(pb.ReadPageRequest(), timeout=20) for _ in range(count)]
            assert held.wait(20)
            replies += [stub.ReadPage(pb.ReadPageRequest(), timeout=20) for _ in range(count)]
        assert len(replies) == 3 * count
        release.set()
        begun = time.monotonic()
        traces.close()
        assert time.monotonic() - begun < 10


def test_without_the_extra_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with pytest.raises(InvalidInputError, match=r"traces.endpoint.*pip install 'lightpage\[traces\]'"):
        Traces("http://127.0.0.1:4317")
