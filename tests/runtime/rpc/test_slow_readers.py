"""Callers that open streams and do not read them keep nobody waiting, and are hung up on."""

from __future__ import annotations

import grpc
import pytest

from runtime.errors import StalledError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.service.limits import Limits
from tests.runtime.rpc.stage import Running, Start, refused_as
from tests.waiting import eventually

SMALL_WINDOW = (("grpc.http2.bdp_probe", 0), ("grpc.http2.lookahead_bytes", 1024))
"""So that few replies fill what the network holds."""
UNREAD = pb.ReadPagesRequest(count=4096, options=pb.DecodeOptions(want_phase=True, want_concentration=True))


def unread(service: Running, count: int) -> list[grpc.Call]:
    """Streams of replies that nobody takes."""
    service.channels.append(grpc.insecure_channel(service.server.target, SMALL_WINDOW))
    read = service.channels[-1].unary_stream("/lightpage.v1.Lightpage/ReadPages", pb.ReadPagesRequest.SerializeToString)
    return [read(UNREAD, timeout=600) for _ in range(count)]


def test_ranges_that_nobody_reads_keep_no_place(start: Start) -> None:
    service = start(limits=Limits(concurrent_ranges=2))
    calls = unread(service, 3)
    eventually(lambda: service.count("lightpage_calls_in_flight") == 3)
    eventually(lambda: service.plane.ranges.busy == 0)
    assert len(list(service.client.read_pages([1, 2, 3]))) == 3
    for call in calls:
        call.cancel()


def test_a_range_that_is_not_read_is_ended(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    service = start(limits=Limits(reader_s=0.2, concurrent_calls=1))
    (call,) = unread(service, 1)
    eventually(lambda: service.count("lightpage_calls_in_flight") == 1)
    eventually(lambda: is_answered(service))  # it counts as no load any more
    with pytest.raises(grpc.RpcError) as caught:
        list(call)  # type: ignore[call-overload]
    told = refused_as(caught.value)
    assert (told.code, type(told.error)) == (grpc.StatusCode.CANCELLED, StalledError)
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


def is_answered(service: Running) -> bool:
    try:
        return service.client.describe().model.current
    except Exception:
        return False


def test_a_reader_that_pauses_for_less_than_that_gets_all(start: Start) -> None:
    assert sum(1 for _ in start().client.read_pages(count=100)) == 100
