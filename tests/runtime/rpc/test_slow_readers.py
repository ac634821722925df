"""Callers that open streams and do not read them keep nobody waiting, and are hung up on."""

from __future__ import annotations

import grpc
import pytest

from runtime.errors import StalledError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.service.limits import Limits
from runtime.wire.status import error_of
from tests.runtime.rpc.stage import Start, wait_until

SMALL_WINDOW = (("grpc.http2.bdp_probe", 0), ("grpc.http2.lookahead_bytes", 1024))
"""So that few replies fill what the network holds."""
FULL = pb.DecodeOptions(want_phase=True, want_concentration=True)


def test_ranges_that_nobody_reads_keep_no_place(start: Start) -> None:
    service = start(Limits(concurrent_ranges=2, deadline_s=5.0))
    request = pb.ReadPagesRequest(count=4096, options=FULL)
    with grpc.insecure_channel(service.server.target, SMALL_WINDOW) as channel:
        calls = [service.stub(channel).ReadPages(request, timeout=60) for _ in range(3)]
        read = service.count("lightpage_pages_total", model_version="toy-1")
        assert wait_until(lambda: service.count("lightpage_pages_total", model_version="toy-1") > read)

        def stands_still() -> bool:
            before = service.count("lightpage_pages_total", model_version="toy-1")
            return not wait_until(lambda: service.count("lightpage_pages_total", model_version="toy-1") > before, 0.2)

        assert wait_until(stands_still)
        assert service.plane.ranges.busy == 0
        assert len(list(service.client.read_pages([1, 2, 3]))) == 3
        for call in calls:
            call.cancel()


def test_a_range_that_is_not_read_is_ended(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    service = start(Limits(reader_s=0.2))
    with grpc.insecure_channel(service.server.target, SMALL_WINDOW) as channel:
        call = service.stub(channel).ReadPages(pb.ReadPagesRequest(count=4096, options=FULL), timeout=20)
        calls = service.server._dispatcher
        assert wait_until(lambda: len(calls._watching) == 1)  # no load any more
        assert not calls._active
        with pytest.raises(grpc.RpcError) as caught:
            list(call)
        assert caught.value.code() is grpc.StatusCode.CANCELLED
    assert isinstance(error_of(caught.value, "here"), StalledError)
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


def test_a_reader_that_pauses_for_less_than_that_gets_all(start: Start) -> None:
    service = start(Limits(reader_s=20.0))
    assert sum(1 for _ in service.client.read_pages(count=300)) == 300
