"""What fails for want of storage or of memory is called that: no finding about a page, and no sign of drift."""

from __future__ import annotations

import errno
import os
import tempfile
import time
from pathlib import Path

import grpc
import pytest
from google.rpc import error_details_pb2 as rpc_details
from google.rpc import status_pb2 as rpc_status

from lightpage.errors import LightpageError, StorageError, SurroundingsError
from runtime.acquisition.source import Shot
from runtime.decoding.decoder import Decoder
from runtime.errors import StoreError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.wire.status import STATUS_KEY, foreseen, reason_name, refusal_of, status_of, trailers
from tests.runtime.rpc.stage import Running, Start, a_page

EIO, ENOSPC, EMFILE, ENOMEM = (
    OSError(number, os.strerror(number)) for number in (errno.EIO, errno.ENOSPC, errno.EMFILE, errno.ENOMEM)
)
ALLOCATION = RuntimeError("[ONNXRuntimeError] : 6 : RUNTIME_EXCEPTION : Failed to allocate memory for requested buffer")


@pytest.mark.parametrize(
    ("error", "code", "reason"),
    [
        (StorageError("recording", "EIO", "data"), grpc.StatusCode.UNAVAILABLE, "STORAGE"),
        (SurroundingsError("service", "ENOMEM", "memory"), grpc.StatusCode.RESOURCE_EXHAUSTED, "SURROUNDINGS"),
        (EIO, grpc.StatusCode.UNAVAILABLE, "STORAGE"),
        (ENOSPC, grpc.StatusCode.RESOURCE_EXHAUSTED, "SURROUNDINGS"),
        (EMFILE, grpc.StatusCode.RESOURCE_EXHAUSTED, "SURROUNDINGS"),
        (ENOMEM, grpc.StatusCode.RESOURCE_EXHAUSTED, "SURROUNDINGS"),
        (MemoryError(), grpc.StatusCode.RESOURCE_EXHAUSTED, "SURROUNDINGS"),
        (RuntimeError("can't start new thread"), grpc.StatusCode.RESOURCE_EXHAUSTED, "SURROUNDINGS"),
        (ALLOCATION, grpc.StatusCode.RESOURCE_EXHAUSTED, "SURROUNDINGS"),
        (ValueError("some bug"), grpc.StatusCode.INTERNAL, "INTERNAL"),
        (FileNotFoundError(errno.ENOENT, "x"), grpc.StatusCode.INTERNAL, "INTERNAL"),
    ],
)
def test_each_has_its_status_and_when_to_try_again(error: Exception, code: grpc.StatusCode, reason: str) -> None:
    assert (status_of(error), reason_name(error)) == (code, reason)
    assert refusal_of(error).code == code.value[0]
    status, retry = rpc_status.Status.FromString(dict(trailers(error))[STATUS_KEY]), rpc_details.RetryInfo()
    told = [detail.Unpack(retry) for detail in status.details]
    assert any(told) == (reason != "INTERNAL")
    assert isinstance(foreseen(error), LightpageError) == (reason != "INTERNAL")


@pytest.fixture
def service(start: Start) -> Running:
    return start()


def lost(service: Running) -> float:
    return sum(
        service.count("lightpage_pages_lost_total", reason=name.removeprefix("LOSS_REASON_"))
        for name in pb.LossReason.keys()  # noqa: SIM118 — no dictionary
    )


@pytest.mark.parametrize("request_id", ["", "shift-1"])
def test_a_page_that_its_storage_does_not_give_is_no_finding_and_may_be_asked_for_again(
    request_id: str, service: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    shots = service.source.shot

    def fails(timeout_s: float = 1.0, page: int | None = None) -> Shot:
        raise StorageError("recording R.h5: dataset 'in_phase'", "Input/output error", "data that can be read")

    monkeypatch.setattr(service.source, "shot", fails)
    with pytest.raises(StorageError, match="in_phase"):
        service.client.read_page(3, request_id=request_id)
    (refused,) = service.client.read_pages([3])
    assert isinstance(refused, StorageError)
    assert lost(service) == 0
    monkeypatch.setattr(service.source, "shot", shots)
    assert service.client.read_page(3, request_id=request_id).page == 3


@pytest.mark.parametrize("error", [MemoryError(), ALLOCATION], ids=["python", "onnxruntime"])
def test_a_decode_for_which_memory_is_short_says_so(
    error: Exception, service: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    def short(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(Decoder, "infer", short)
    with pytest.raises(SurroundingsError, match="memory"):
        service.client.decode(a_page()[1], 16)
    with pytest.raises(SurroundingsError, match="memory"):
        service.client.read_page(1)
    assert lost(service) == 0
    assert service.count("lightpage_rejects_total", reason="SURROUNDINGS") == 2


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """No folder can be written, as on a read-only root without /tmp."""

    def none(*_: object, **__: object) -> str:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp', '/var/tmp']")

    monkeypatch.setattr(tempfile, "mkdtemp", none)


@pytest.mark.usefixtures("nowhere")
def test_a_recalibration_without_any_folder_is_refused_before_it_begins(service: Running) -> None:
    trouble = service.recalibrator.no_room()
    assert isinstance(trouble, StoreError)
    assert "--store" in trouble.expected
    with pytest.raises(StoreError):
        service.client.recalibrate(count=2)
    with pytest.raises(StoreError):
        service.client.start_recalibration(count=2)
    assert status_of(trouble) is grpc.StatusCode.FAILED_PRECONDITION
    assert service.client.jobs() == []


@pytest.mark.usefixtures("nowhere")
def test_a_store_is_folder_enough(start: Start, tmp_path: Path) -> None:
    assert start(store=tmp_path / "store").recalibrator.no_room() is None


def test_a_full_disk_is_no_missing_folder(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> str:
        raise ENOSPC

    monkeypatch.setattr(tempfile, "mkdtemp", full)
    with pytest.raises(SurroundingsError, match="room"):
        service.client.start_recalibration(count=2)


@pytest.mark.long
def test_a_client_that_asks_for_a_sign_of_life_every_ten_seconds_without_calls_is_not_hung_up_on(
    service: Running,
) -> None:
    options = (
        ("grpc.keepalive_time_ms", 10_000),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.max_pings_without_data", 0),
    )
    states = list[grpc.ChannelConnectivity]()
    with grpc.insecure_channel(service.server.target, options) as channel:
        channel.subscribe(states.append)
        grpc.channel_ready_future(channel).result(10)
        time.sleep(55)  # five of them, of which the default forgives two
        service.stub(channel).Describe(pb.DescribeRequest(), timeout=10)
    after = states[states.index(grpc.ChannelConnectivity.READY) + 1 :]
    assert set(after) <= {grpc.ChannelConnectivity.SHUTDOWN}
