"""A connection that has become old is left without losing a call: so callers spread over servers that are added."""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest

from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.service.caller import Caller
from runtime.service.limits import Limits
from tests.runtime.rpc.stage import Running, Start, wait_until

AGE_S = 0.3


def peers(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Where finished calls came from: each connection has a port of its own."""
    return [record.told["peer"] for record in caplog.records if hasattr(record, "told")]


def connects_anew(service: Running, caplog: pytest.LogCaptureFixture, within_s: float = 10.0) -> bool:
    """Whether a client that goes on calling is soon heard on another connection; no call of it may fail."""
    service.client.describe()
    assert wait_until(lambda: len(peers(caplog)) > 0)
    first = peers(caplog)[0]

    def another() -> bool:
        service.client.describe()
        return any(peer != first for peer in peers(caplog))

    return wait_until(another, within_s)


def test_a_client_connects_anew_and_the_calls_of_the_old_connection_end_well(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "runtime.rpc.call_log")
    service = start(Limits(concurrent_decodes=1, connection_age_s=AGE_S))
    service.plane.decodes.take(Caller())  # so that the call below is in flight all the time
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(service.client.read_page)
        assert wait_until(lambda: service.count("lightpage_calls_in_flight") == 1)
        assert connects_anew(service, caplog)
        assert not waiting.done()
        service.plane.decodes.give_back()
        assert waiting.result(20).levels == 16


def test_calls_that_outlive_the_grace_are_ended(start: Start) -> None:
    service = start(Limits(concurrent_decodes=1, connection_age_s=AGE_S, connection_grace_s=AGE_S))
    service.plane.decodes.take(Caller())
    with grpc.insecure_channel(service.server.target) as channel, pytest.raises(grpc.RpcError) as error:
        service.stub(channel).ReadPage(pb.ReadPageRequest(), timeout=20)
    assert error.value.code() == grpc.StatusCode.UNAVAILABLE
    service.plane.decodes.give_back()


def test_without_an_age_a_connection_stays(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "runtime.rpc.call_log")
    assert not connects_anew(start(), caplog, 4 * AGE_S)
