"""What fails for want of storage or of memory is called that: no finding about a page, and no sign of drift."""

from __future__ import annotations

import errno
import tempfile
import threading
from pathlib import Path

import grpc
import pytest

from lightpage.errors import StorageError, SurroundingsError
from runtime.acquisition.source import Shot
from runtime.decoding.decoder import Decoder
from runtime.errors import StoreError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from tests.runtime.rpc.stage import Running, Start, a_page

ALLOCATION = RuntimeError("[ONNXRuntimeError] : 6 : RUNTIME_EXCEPTION : Failed to allocate memory for requested buffer")


def lost(service: Running) -> float:
    return sum(
        service.count("lightpage_pages_lost_total", reason=name.removeprefix("LOSS_REASON_"))
        for name in pb.LossReason.keys()  # noqa: SIM118 — no dictionary
    )


@pytest.mark.parametrize("request_id", ["", "shift-1"])
def test_a_page_that_its_storage_does_not_give_is_no_finding_and_may_be_asked_for_again(
    request_id: str, start: Start
) -> None:
    service, fails = start(), [True]

    def read(shot: Shot) -> Shot:
        if fails:
            raise StorageError("recording R.h5: dataset 'in_phase'", "Input/output error", "data that can be read")
        return shot

    service.reading(read)
    with pytest.raises(StorageError):
        service.client.read_page(3, request_id=request_id)
    (refused,) = service.client.read_pages([3])
    assert isinstance(refused, StorageError)
    assert lost(service) == 0
    fails.clear()
    assert service.client.read_page(3, request_id=request_id).page == 3


@pytest.mark.parametrize("error", [MemoryError(), ALLOCATION], ids=["python", "onnxruntime"])
def test_a_decode_for_which_memory_is_short_says_so(
    error: Exception, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    def short(*_: object, **__: object) -> None:
        raise error

    service = start()
    monkeypatch.setattr(Decoder, "infer", short)
    for call in (lambda: service.client.decode(a_page()[1], 16), lambda: service.client.read_page(1)):
        with pytest.raises(SurroundingsError):
            call()  # type: ignore[no-untyped-call]
    assert lost(service) == 0
    assert service.count("lightpage_rejects_total", reason="SURROUNDINGS") == 2


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """No folder can be written, as on a read-only root without /tmp."""

    def none(*_: object, **__: object) -> str:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp', '/var/tmp']")

    monkeypatch.setattr(tempfile, "mkdtemp", none)


@pytest.mark.usefixtures("nowhere")
def test_a_recalibration_without_any_folder_is_refused_before_it_begins(start: Start, tmp_path: Path) -> None:
    service = start()
    trouble = service.recalibrator.no_room()
    assert isinstance(trouble, StoreError)
    assert "--store" in trouble.expected
    for call in (service.client.recalibrate, service.client.start_recalibration):
        with pytest.raises(StoreError):
            call(count=2)  # type: ignore[operator]
    assert service.client.jobs() == []
    assert start(store=tmp_path / "store").recalibrator.no_room() is None


def test_a_full_disk_is_no_missing_folder(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> str:
        raise OSError(errno.ENOSPC, "No space left on device")

    service = start()
    monkeypatch.setattr(tempfile, "mkdtemp", full)
    with pytest.raises(SurroundingsError):
        service.client.start_recalibration(count=2)


@pytest.mark.long  # gRPC counts a caller's signs of life by its own clock: five of them take 55 s
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
        grpc.channel_ready_future(channel).result(30)
        threading.Event().wait(55)  # five of them, of which the default forgives two
        channel.unary_unary("/lightpage.v1.Lightpage/Describe")(b"", timeout=20)
    after = states[states.index(grpc.ChannelConnectivity.READY) + 1 :]
    assert set(after) <= {grpc.ChannelConnectivity.SHUTDOWN}
