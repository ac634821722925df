"""Where the time of calls goes: the stages of their pages are all of it, and a receiver of OTLP gets them as spans."""

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import grpc
import pytest
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2, trace_service_pb2_grpc
from opentelemetry.proto.trace.v1.trace_pb2 import Span

from lightpage.errors import FrameError, InvalidInputError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.frames.inference_calls import INFERENCE, PREFIX
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.monitoring.logs import MOST_TEXT
from lightpage.runtime.service.monitoring.traces import MOST_PAGES, Traces
from lightpage.runtime.service.stages import Stage
from tests.runtime import coded, toy
from tests.runtime.conftest import begun
from tests.runtime.service.frames.test_inference import infer, request_of, stub_of
from tests.runtime.service.stage import Running, Start, a_page, parts, refused
from tests.waiting import eventually

EXACT_S = 1e-6
"""Sums of doubles of some seconds, in whatever order."""


def seconds(service: Running, method: str, stage: Stage) -> float:
    return service.count("lightpage_stage_seconds_sum", method=method, stage=stage.value)


def all_seconds(service: Running, method: str) -> float:
    return sum(seconds(service, method, stage) for stage in Stage)


def ended(service: Running, method: str, calls: int) -> bool:
    return eventually(lambda: service.count("lightpage_call_seconds_count", method=method) == calls)


def test_the_stages_of_a_pages_calls_are_all_of_their_time(start: Start) -> None:
    service = start()
    pair = a_page()[1]
    turned = FramePair(pair.quadrature, pair.in_phase)
    service.client.frames.decode(pair, 16)
    with pytest.raises(FrameError):
        service.client.frames.decode(turned, 16)
    assert len(list(service.client.frames.decode_many([pair, turned, pair], 16))) == 3
    infer(service, request_of(pair))
    service.client.pages.read()
    for _ in range(2):
        service.client.pages.read(3, request_id="once")
    assert len(list(service.client.pages.read_many(count=3))) == 3
    expected = [("DecodeFrames", 2, 2), ("DecodePages", 1, 3), (f"{PREFIX}ModelInfer", 1, 1)]
    for method, calls, pages in [*expected, ("ReadPage", 3, 3), ("ReadPages", 1, 3)]:
        assert ended(service, method, calls)
        whole = service.count("lightpage_call_seconds_sum", method=method)
        given = [seconds(service, method, stage) for stage in (Stage.RECEIVE, Stage.INFERENCE)]
        assert min(given) > 0
        assert service.count("lightpage_stage_seconds_count", method=method, stage="queue") == pages
        if method == "ReadPages":  # the end of the stream belongs to no page
            assert 0 < all_seconds(service, method) <= whole + EXACT_S
        elif method != "DecodePages":  # whose pages are received while others are decoded
            assert all_seconds(service, method) == pytest.approx(whole, abs=EXACT_S)
    for method, count in (("DecodeFrames", 1), ("DecodePages", 3)):
        assert service.count("lightpage_stage_seconds_count", method=method, stage="respond") == count
    assert service.count("lightpage_rejects_total", reason="FRAMES_DISAGREE") == 2


def test_waiting_for_a_slot_is_told_apart_from_the_work(start: Start) -> None:
    service, size = start(limits=Limits(concurrent_decodes=1)), 2 * toy.SHAPE[0] * toy.SHAPE[1]
    with ThreadPoolExecutor(1) as pool:
        with service.plane.decodes.held(Caller()):
            assert (service.count("lightpage_decodes_busy"), service.count("lightpage_decodes_slots")) == (1, 1)
            calling = pool.submit(service.client.frames.decode, a_page()[1], 16)
            eventually(lambda: service.count("lightpage_decodes_waiting") == 1)
            assert service.count("lightpage_receive_buffer_bytes") == size
        calling.result(60)
    assert ended(service, "DecodeFrames", 1)
    assert seconds(service, "DecodeFrames", Stage.QUEUE) > 0
    assert service.count("lightpage_receive_buffer_bytes") == 0
    assert service.count("lightpage_received_bytes_total") == size


def test_user_bytes_have_a_stage_of_their_own(start: Start, tmp_path: Path) -> None:
    bundle = coded.bundle(tmp_path / "toy.zip")
    service = start(bundle, source=coded.ShownPages(coded.pages(bundle, tmp_path)))
    service.client.pages.read(1, user_data=True)
    assert len(list(service.client.pages.read_data(0, 3))) >= 3
    for method, pages in (("ReadPage", 1), ("ReadData", 3)):
        assert ended(service, method, 1)
        assert service.count("lightpage_stage_seconds_count", method=method, stage="code") == pages


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
    found = [one for one in spans if one.parent_span_id == parent.span_id]
    return sorted(found, key=lambda one: one.start_time_unix_nano)


def test_a_decode_is_a_span_with_its_stages_within_its_callers_trace(decoder: Decoder) -> None:
    with receiving() as (receiver, endpoint), traced(decoder, endpoint) as service:
        header = (("traceparent", SAMPLED),)
        service.stub.DecodeFrames(parts(a_page()[1], correlation_id="order-7"), timeout=20, metadata=header)
        refused(lambda: service.stub.GetJob(pb.GetJobRequest(id="none"), timeout=20))
        stub_of(service).ServerLive(oip.ServerLiveRequest(), timeout=20)
    call = next(span for span in receiver.spans if span.name == "lightpage.v1.Lightpage/DecodeFrames")
    assert receiver.services == {"lightpage"}
    assert (call.trace_id.hex(), call.parent_span_id.hex()) == (TRACE, CALLER)
    assert call.kind == Span.SPAN_KIND_SERVER
    told = attributes(call)
    assert (told["rpc.system"], told["rpc.service"]) == ("grpc", "lightpage.v1.Lightpage")
    assert told["rpc.method"] == "DecodeFrames"
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
    assert attributes(failed)["lightpage.reason"] == "NO_SUCH_JOB"
    assert attributes(failed)["rpc.grpc.status_code"] == grpc.StatusCode.NOT_FOUND.value[0]
    live = next(span for span in receiver.spans if span.name == f"{INFERENCE.full_name}/ServerLive")
    assert (attributes(live)["rpc.service"], attributes(live)["rpc.method"]) == (INFERENCE.full_name, "ServerLive")


def test_a_call_of_many_pages_has_a_span_of_each_up_to_a_number_and_of_a_long_text_its_beginning(
    decoder: Decoder,
) -> None:
    count, text = MOST_PAGES + 2, 2 * MOST_TEXT * "a"
    with receiving() as (receiver, endpoint), traced(decoder, endpoint) as service:
        asked = pb.ReadPagesRequest(count=count, correlation_id=text)
        assert len(list(service.stub.ReadPages(asked, timeout=60))) == count
    call = next(span for span in receiver.spans if span.name.endswith("/ReadPages"))
    assert attributes(call)["lightpage.pages"] == count
    assert attributes(call)["lightpage.correlation_id"] == MOST_TEXT * "a"
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


def test_without_the_extra_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    with pytest.raises(InvalidInputError) as error:
        Traces("http://127.0.0.1:4317")
    assert "lightpage[traces]" in error.value.expected
