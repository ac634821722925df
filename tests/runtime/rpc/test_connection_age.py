"""A connection that has become old is left without losing a call: so callers spread over servers that are added."""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest

from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.service.caller import Caller
from runtime.service.limits import Limits
from tests.runtime.rpc.stage import Start, refused
from tests.waiting import eventually

AGE_S = 0.2


def test_a_client_connects_anew_and_the_calls_of_the_old_connection_end_well(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "runtime.rpc.call_log")
    service = start(limits=Limits(concurrent_decodes=1, connection_age_s=AGE_S))

    def peers() -> set[str]:
        """Where a call came from by now: each connection has a port of its own."""
        service.client.describe()  # no call may fail
        return {record.told["peer"] for record in caplog.records if hasattr(record, "told")}

    with ThreadPoolExecutor(1) as pool:
        with service.plane.decodes.held(Caller()):  # so that the call below is in flight all the time
            waiting = pool.submit(service.client.read_page)
            eventually(lambda: service.count("lightpage_calls_in_flight") == 1)
            eventually(lambda: len(peers()) > 1)
            assert not waiting.done()
        assert waiting.result(60).levels == 16


def test_calls_that_outlive_the_grace_are_ended(start: Start) -> None:
    service = start(limits=Limits(concurrent_decodes=1, connection_age_s=AGE_S, connection_grace_s=AGE_S))
    with service.plane.decodes.held(Caller()):
        answer = refused(lambda: service.stub.ReadPage(pb.ReadPageRequest(), timeout=60))
    assert answer.code is grpc.StatusCode.UNAVAILABLE
