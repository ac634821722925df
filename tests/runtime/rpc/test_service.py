"""The running service: what it answers, what it refuses, and that it loses no request and keeps nothing behind."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import grpc
import h5py
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import (
    BundleError,
    BusyError,
    FrameError,
    InvalidInputError,
    LightpageError,
    LimitError,
    PageError,
    RecalibrationRefusedError,
    RecordingError,
)
from lightpage.metrics.measures import measure
from lightpage.page.symbols import pilot_mask
from lightpage.recording.frame_pair import FramePair
from runtime.acquisition.sources import open_source
from runtime.bundle.bundle import Bundle
from runtime.client.client import LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.decoding.tracking import NoTracker
from runtime.errors import Reason, SourceError, StoppingError, UnconfirmedPageError
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.recalibration.outcome import RefitResult
from runtime.rpc.call import SERVICE
from runtime.rpc.server import LightpageServer
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane
from runtime.service.limits import Limits
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import KEPT_MODELS, ModelRegistry
from runtime.wire.messages import KnownPilots
from runtime.wire.status import detail_of, without_folders
from tests.runtime import toy
from tests.runtime.rpc.stage import Running, Start, a_page, wait_until

DRIFTED = (150.0, 62.0)


def test_the_service_describes_itself(start: Start) -> None:
    service = start()
    description = service.client.describe()
    assert description.model.version == "toy-1"
    assert description.model.current
    assert (description.frame_shape, description.page_shape) == (toy.SHAPE, toy.PAGE)
    assert (description.frame_dtype, description.bit_depth) == ("uint8", 8)
    assert (description.source, description.source_levels) == ("toy:device", 16)
    assert "toy" in description.profile_toml
    assert (description.pilot_mask == pilot_mask(toy.PROFILE)).all()
    assert "angle_deg" in description.calibration_toml


def test_a_sent_pair_comes_back_as_the_local_decoder_would_decode_it(start: Start, decoder: Decoder) -> None:
    symbols, pair = a_page()
    here = decoder.decode(pair, 16)
    there = start().client.decode(pair, 16, want_concentration=True, want_phase=True)
    assert (there.symbols == symbols).all()
    for name in ("symbols", "confidence", "concentration", "phase"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
    assert there.piston_rad == pytest.approx(here.piston_rad)
    assert there.model_version == "toy-1"
    timings = there.timings
    assert 0 < timings.inference_s < timings.decode_s < timings.total_s
    assert 0 < timings.receive_s < timings.total_s


def test_only_what_is_asked_for_is_sent(start: Start) -> None:
    page = start().client.decode(a_page()[1], 16, quantised=True)
    assert page.concentration is None
    assert page.phase is None
    assert set(np.unique(page.confidence * 255 % 1)) == {0}


def test_quantised_confidence_never_claims_more(start: Start) -> None:
    client, pair = start().client, a_page(64)[1]
    exact, coarse = client.decode(pair, 64), client.decode(pair, 64, quantised=True)
    assert (coarse.confidence <= exact.confidence).all()
    assert (exact.confidence - coarse.confidence).max() <= 1 / 255


@pytest.mark.parametrize("levels", [2, 5, 256])
def test_any_level_count_can_be_asked_for(levels: int, start: Start) -> None:
    page = start().client.decode(a_page(levels)[1], levels)
    assert page.levels == levels
    assert page.symbols.max() < levels


def test_pilots_of_ones_own_can_be_sent(start: Start) -> None:
    symbols = np.random.default_rng(5).integers(16, size=toy.PAGE).astype(np.uint8)
    mask = np.zeros(toy.PAGE, bool)
    mask[::4, ::6] = True
    page = start().client.decode(toy.ToyDevice().page(symbols, 16, 2.0), 16, pilots=KnownPilots(mask, symbols, 16))
    assert (page.symbols == symbols).all()


def test_pages_are_read_from_the_source_in_turn_or_by_number(start: Start) -> None:
    client = start().client
    pages = [client.read_page(want_written=True), client.read_page(want_written=True), client.read_page(9)]
    assert [page.page for page in pages] == [0, 1, 9]
    for page in pages[:2]:
        assert page.levels == 16
        assert page.written is not None
        assert page.pilot_mask is not None
        assert (page.symbols == page.written).all()
        assert page.pilot_mask.sum() > 4
    assert pages[2].written is None
    coarse = client.read_page(1, 8)  # the same page seen in other levels keeps its phase reference
    assert pages[1].written is not None
    even = pages[1].written % 2 == 0
    assert (coarse.symbols[even] == pages[1].written[even] // 2).all()


@pytest.mark.parametrize(
    ("pair", "kind", "named"),
    [
        (FramePair(np.full((64, 95), 9, np.uint8), np.full((64, 95), 9, np.uint8)), FrameError, "64x95"),
        (FramePair(np.full(toy.SHAPE, 9, np.uint16), np.full(toy.SHAPE, 9, np.uint16)), FrameError, "uint16"),
        (FramePair(np.zeros(toy.SHAPE, np.uint8), np.zeros(toy.SHAPE, np.uint8)), FrameError, "in-phase frame.*black"),
        (FramePair(a_page()[1].quadrature, a_page()[1].in_phase), FrameError, "swapped"),
    ],
)
def test_bad_frames_are_the_callers_fault_and_named(
    pair: FramePair, kind: type[LightpageError], named: str, start: Start
) -> None:
    with pytest.raises(kind, match=named):
        start().client.decode(pair, 16)


def test_bad_requests_are_the_callers_fault_and_named(start: Start) -> None:
    service = start()
    with pytest.raises(PageError, match="levels"):
        service.client.decode(a_page()[1], 1000)
    with pytest.raises(FrameError, match="10 bits"):
        service.client.decode(a_page()[1], 16, bit_depth=10)
    mask = np.ones((2, 2), bool)
    with pytest.raises(PageError, match="pilots"):
        service.client.decode(a_page()[1], 16, pilots=KnownPilots(mask, np.zeros((2, 2), np.uint8), 16))
    with pytest.raises(InvalidInputError, match="recalibrate"):
        service.client.recalibrate(count=0)


def call_with(service: Running, parts: list[pb.DecodeFramesRequest]) -> tuple[grpc.StatusCode, str]:
    with grpc.insecure_channel(service.server.target) as channel:
        try:
            service.stub(channel).DecodeFrames(iter(parts), timeout=20)
        except grpc.RpcError as error:
            return error.code(), error.details()
    return grpc.StatusCode.OK, ""


def header(
    rows: int = toy.SHAPE[0],
    columns: int = toy.SHAPE[1],
    kind: int = pb.PIXEL_TYPE_UINT8,
    options: pb.DecodeOptions | None = None,
    pilots: pb.Pilots | None = None,
) -> pb.DecodeHeader:
    options = options or pb.DecodeOptions(levels=16)
    return pb.DecodeHeader(
        rows_px=rows, columns_px=columns, pixel_type=kind, bit_depth=8, options=options, pilots=pilots
    )


BAD_OPTIONS = (
    (pb.DecodeOptions(levels=999), "levels"),
    (pb.DecodeOptions(levels=1), "levels"),
    (pb.DecodeOptions(levels=16, confidence_format=7), "confidence_format"),  # type: ignore[arg-type]
)


def test_bad_options_are_named_before_a_frame_is_sent(start: Start) -> None:
    service = start()
    begun = [(header(options=options), named) for options, named in BAD_OPTIONS]
    for begin, named in [*begun, (header(pilots=pb.Pilots(mask=b"abc")), "pilots")]:
        code, text = call_with(service, [pb.DecodeFramesRequest(header=begin)])
        assert (code, text.partition(":")[0]) == (grpc.StatusCode.INVALID_ARGUMENT, named)


def test_bad_options_take_no_page_from_the_source(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        stub = service.stub(channel)
        for options, named in BAD_OPTIONS:
            request = pb.ReadPageRequest(options=options)
            code, text = status(lambda request=request: stub.ReadPage(request, timeout=20))  # type: ignore[misc]
            assert (code, text.partition(":")[0]) == (grpc.StatusCode.INVALID_ARGUMENT, named)
    assert service.client.read_page().page == 0


def test_a_broken_stream_is_the_callers_fault_and_named(start: Start) -> None:
    service, size = start(), toy.SHAPE[0] * toy.SHAPE[1]
    begin, chunk = pb.DecodeFramesRequest(header=header()), pb.DecodeFramesRequest
    cases = [
        ([], "header"),
        ([chunk(chunk=b"abc")], "header"),
        ([begin], "0 bytes"),
        ([begin, chunk(chunk=bytes(size))], f"{size} bytes"),
        ([begin, chunk(chunk=bytes(2 * size + 1))], f"{2 * size} bytes"),
        ([begin, begin], "second header"),
        ([chunk(header=header(kind=0))], "pixel_type"),
        ([chunk(header=header(kind=77))], "pixel_type"),
    ]
    for parts, named in cases:
        code, text = call_with(service, parts)
        assert code == grpc.StatusCode.INVALID_ARGUMENT, text
        assert named in text


def test_oversize_requests_are_refused_before_anything_is_allocated(start: Start) -> None:
    service = start(Limits(pair_bytes=1 << 20, chunk_bytes=1 << 16, message_bytes=1 << 20))
    code, text = call_with(service, [pb.DecodeFramesRequest(header=header(60_000, 60_000))])
    assert code == grpc.StatusCode.RESOURCE_EXHAUSTED
    assert "7200000000 bytes" in text
    begin = pb.DecodeFramesRequest(header=header())
    code, text = call_with(service, [begin, pb.DecodeFramesRequest(chunk=bytes((1 << 16) + 1))])
    assert code == grpc.StatusCode.RESOURCE_EXHAUSTED
    assert "chunk" in text
    code, _ = call_with(service, [begin, pb.DecodeFramesRequest(chunk=bytes(2 << 20))])
    assert code == grpc.StatusCode.RESOURCE_EXHAUSTED
    assert (service.client.decode(a_page()[1], 16).symbols == a_page()[0]).all()


def test_a_client_that_leaves_mid_call_leaves_nothing_behind(start: Start) -> None:
    service = start(Limits(receive_bytes=1 << 20))
    gone = threading.Event()

    def endless() -> Iterator[pb.DecodeFramesRequest]:
        yield pb.DecodeFramesRequest(header=header())
        yield pb.DecodeFramesRequest(chunk=bytes(100))
        gone.wait(20)

    for _ in range(6):
        with grpc.insecure_channel(service.server.target) as channel:
            call = service.stub(channel).DecodeFrames.future(endless(), timeout=20)
            assert wait_until(lambda: service.count("lightpage_calls_in_flight") == 1)
            call.cancel()
        assert wait_until(lambda: service.count("lightpage_calls_in_flight") == 0)
    gone.set()
    assert wait_until(lambda: service.plane.received.used == 0)
    assert (service.client.decode(a_page()[1], 16).symbols == a_page()[0]).all()
    assert service.count("lightpage_pages_total", model_version="toy-1") == 1
    assert service.plane.received.used == 0


def test_clients_that_stall_cost_the_others_nothing_and_are_cut_off(start: Start) -> None:
    service = start(Limits(stall_s=1.0))
    over = threading.Event()

    def stalling() -> Iterator[pb.DecodeFramesRequest]:
        yield pb.DecodeFramesRequest(header=header())
        yield pb.DecodeFramesRequest(chunk=bytes(100))
        over.wait(20)

    with grpc.insecure_channel(service.server.target) as channel:
        calls = [service.stub(channel).DecodeFrames.future(stalling(), timeout=20) for _ in range(60)]
        assert wait_until(lambda: service.count("lightpage_calls_in_flight") == 60)
        assert (service.client.decode(a_page()[1], 16).symbols == a_page()[0]).all()
        assert service.count("lightpage_calls_in_flight") == 60  # all of them are still there
        for call in calls:
            with pytest.raises(grpc.RpcError, match="within 1 s") as error:
                call.result()
            assert error.value.code() == grpc.StatusCode.CANCELLED
        over.set()
    assert service.plane.received.used == 0


def test_waiting_for_a_slot_is_not_stalling(start: Start) -> None:
    service = start(Limits(concurrent_decodes=1, receive_s=0.3, stall_s=0.3))
    service.plane.decodes.take(Caller())
    free = threading.Timer(0.8, service.plane.decodes.give_back)
    free.start()
    assert (service.client.decode(a_page()[1], 16).symbols == a_page()[0]).all()
    free.join(5)


def test_too_many_at_once_are_told_to_come_back(start: Start) -> None:
    service = start(Limits(concurrent_decodes=1, deadline_s=0.2))
    service.plane.decodes.take(Caller())
    with pytest.raises(BusyError, match="try again"):
        service.client.decode(a_page()[1], 16)
    service.plane.decodes.give_back()
    assert service.client.decode(a_page()[1], 16).levels == 16


def test_a_page_is_not_read_from_the_source_before_there_is_room_to_decode_it(start: Start) -> None:
    service = start(Limits(concurrent_decodes=1, deadline_s=0.2))
    service.plane.decodes.take(Caller())
    for _ in range(3):
        with pytest.raises(BusyError, match="try again"):
            service.client.read_page()
    service.plane.decodes.give_back()
    page = service.client.read_page()
    assert page.page == 0  # none was taken from the source in vain
    assert 0 < page.timings.receive_s + page.timings.decode_s < page.timings.total_s


def status(call: Callable[[], object]) -> tuple[grpc.StatusCode, str]:
    with pytest.raises(grpc.RpcError) as error:
        call()
    return error.value.code(), error.value.details()


def test_a_call_without_a_slot_is_resource_exhausted(start: Start) -> None:
    service = start(Limits(concurrent_decodes=1, deadline_s=0.2))
    service.plane.decodes.take(Caller())
    with grpc.insecure_channel(service.server.target) as channel:
        code, text = status(lambda: service.stub(channel).ReadPage(pb.ReadPageRequest(), timeout=20))
    service.plane.decodes.give_back()
    assert code == grpc.StatusCode.RESOURCE_EXHAUSTED
    assert "try again later" in text


def test_a_damaged_page_of_the_source_is_the_services_own_fault(toy_zip: Path, tmp_path: Path) -> None:
    path = tmp_path / "source.h5"
    toy.write_toy_recording(path, toy.ToyDevice(), 16, 4)
    with h5py.File(path, "r+") as file:
        for name in ("in_phase", "quadrature", "reference_in_phase", "reference_quadrature"):
            data = file[name][()].astype(np.uint16)
            del file[name]
            file[name] = data
        file["quadrature"][1] = 0
        file["in_phase"][2, 5, 5] = 256
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)), open_source(f"recording:{path}"))
    server = LightpageServer(plane, Recalibrator(plane, toy.fit_references))
    with server, grpc.insecure_channel(server.target) as channel, LightpageClient(server.target) as client:
        stub = pb_grpc.LightpageStub(channel)
        for page, named in ((1, "page 1 of recording:source.h5: quadrature frame"), (2, "page 2, recording source.h5")):
            code, text = status(lambda page=page: stub.ReadPage(pb.ReadPageRequest(page=page), timeout=20))  # type: ignore[misc]
            assert code == grpc.StatusCode.FAILED_PRECONDITION
            assert text.startswith(named)
            assert str(tmp_path) not in text
            with pytest.raises(SourceError) as error:
                client.read_page(page)
            assert str(tmp_path) not in str(error.value)
        options = pb.DecodeOptions(levels=1)
        for request in (pb.ReadPageRequest(page=9), pb.ReadPageRequest(page=0, options=options)):
            code, _ = status(lambda request=request: stub.ReadPage(request, timeout=20))  # type: ignore[misc]
            assert code == grpc.StatusCode.INVALID_ARGUMENT
        recalibrate = pb.RecalibrateRequest(source=pb.SourcePages(pages=[0, 2]))
        code, text = status(lambda: list(stub.Recalibrate(recalibrate, timeout=20)))
        assert code == grpc.StatusCode.FAILED_PRECONDITION
        # what the service itself reads is never the caller's fault
        dark = pb.RecalibrateRequest(source=pb.SourcePages(pages=[0, 1]))
        code, text = status(lambda: list(stub.Recalibrate(dark, timeout=20)))
        assert code == grpc.StatusCode.FAILED_PRECONDITION
        assert text.startswith("known page 1: quadrature frame: got black")
        assert client.describe().source == "recording:source.h5"


def test_pages_without_symbols_are_the_fault_of_who_named_them(start: Start, tmp_path: Path) -> None:
    service = start()
    as_it_was = service.source.shot

    def unknown(timeout_s: float = 1.0, page: int | None = None) -> object:
        found = as_it_was(timeout_s, page)
        return type(found)(found.pair, found.page_index)

    service.source.shot = unknown  # type: ignore[method-assign,assignment]
    toy.write_toy_recording(tmp_path / "plain.h5", toy.ToyDevice(DRIFTED), 16, 2)
    with h5py.File(tmp_path / "plain.h5", "r+") as file:
        del file["symbols"]
    own = pb.RecalibrateRequest(source=pb.SourcePages(count=2))
    named = pb.RecalibrateRequest(recording="plain.h5")
    with grpc.insecure_channel(service.server.target) as channel:
        stub = service.stub(channel)
        code, text = status(lambda: list(stub.Recalibrate(own, timeout=20)))
        assert (code, text.partition(":")[0]) == (grpc.StatusCode.FAILED_PRECONDITION, "pages of toy")
        code, text = status(lambda: list(stub.Recalibrate(named, timeout=20)))
        assert (code, text.partition(":")[0]) == (grpc.StatusCode.INVALID_ARGUMENT, "recording plain.h5")


def test_a_re_fit_is_not_judged_by_the_page_that_it_was_fitted_on(toy_zip: Path, tmp_path: Path) -> None:
    toy.write_toy_recording(path := tmp_path / "source.h5", toy.ToyDevice(DRIFTED), 16, 2)
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)), open_source(f"recording:{path}"))
    server = LightpageServer(plane, Recalibrator(plane, toy.fit_references))
    with server, LightpageClient(server.target) as client:
        with pytest.raises(InvalidInputError, match="known page 1: got the frames of known page 0"):
            client.recalibrate(pages=[1, 1])
        with pytest.raises(InvalidInputError, match="known page 2: got the frames of known page 0"):
            client.recalibrate(count=3)  # more than the source has: it begins again with its first
        assert client.recalibrate(pages=[1, 0]).pages_used == 2


def test_a_damaged_recording_on_the_server_is_the_services_own_fault(start: Start, tmp_path: Path) -> None:
    service = start()
    path = tmp_path / "R.h5"
    toy.write_toy_recording(path, toy.ToyDevice(), 16, 2)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(SourceError, match=r"recording R\.h5"):
        service.client.recalibrate(recording="R.h5")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("recording /srv/data/R.h5: in_phase", "recording R.h5: in_phase"),
        ("bundle /srv/a/b/c.zip: golden.npz", "bundle c.zip: golden.npz"),
        ("recording:/srv/R.h5", "recording:R.h5"),
        ("unable to open file (name = '/srv/R.h5', errno = 2)", "unable to open file (name = 'R.h5', errno = 2)"),
        ("an AIR of 3.1 bit/symbol, uint8/uint16 / 2", "an AIR of 3.1 bit/symbol, uint8/uint16 / 2"),
    ],
)
def test_errors_name_files_without_their_folders(text: str, told: str) -> None:
    assert without_folders(text) == told


def test_an_error_of_any_length_is_cut_before_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at: list[int] = []
    monkeypatch.setattr("runtime.wire.status.without_folders", lambda text: looked_at.append(len(text)) or text)
    error = LightpageError("a" * 5_000_000, "b" * 5_000_000, "c" * 5_000_000)
    detail = detail_of(error)
    assert (len(detail.thing), len(detail.got), len(detail.wanted)) == (1000, 1000, 1000)
    assert max(looked_at) <= 4000


def test_health_is_served_beside_the_service_and_ends_first(start: Start) -> None:
    service = start()
    with grpc.insecure_channel(service.server.target) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        for name in ("", SERVICE.full_name):
            answer = stub.Check(health_pb2.HealthCheckRequest(service=name), timeout=5)
            assert answer.status == health_pb2.HealthCheckResponse.SERVING
        watch = stub.Watch(health_pb2.HealthCheckRequest(service=SERVICE.full_name), timeout=10)
        assert next(watch).status == health_pb2.HealthCheckResponse.SERVING
        ending = threading.Thread(target=service.server.stop, args=(2.0,))
        ending.start()
        assert next(watch).status == health_pb2.HealthCheckResponse.NOT_SERVING
        watch.cancel()
        ending.join(10)
        assert not ending.is_alive()


def test_an_answer_in_flight_survives_the_stop(start: Start) -> None:
    service = start()
    service.plane.decodes.take(Caller())
    service.plane.decodes.take(Caller())
    pages: list[object] = []
    caller = threading.Thread(target=lambda: pages.append(service.client.decode(a_page()[1], 16)))
    caller.start()
    assert wait_until(lambda: service.count("lightpage_calls_in_flight") == 1)
    ending = threading.Thread(target=service.server.stop, args=(10.0,))
    ending.start()
    ending.join(0.3)
    assert ending.is_alive()  # it waits for the answer
    service.plane.decodes.give_back()
    service.plane.decodes.give_back()
    caller.join(10)
    ending.join(10)
    assert len(pages) == 1
    with pytest.raises(LightpageError, match="no connection"):
        service.client.describe()


def air_of(service: Running, pages: int = 3) -> float:
    read = [service.client.read_page(want_phase=True, want_concentration=True, want_written=True) for _ in range(pages)]
    data = ~np.stack([page.pilot_mask for page in read])  # type: ignore[arg-type,misc]
    stacked = [np.stack([getattr(page, name) for page in read])[data] for name in ("phase", "concentration", "written")]
    return measure(*stacked, 16).air_bits_per_symbol


def test_recalibration_over_the_endpoint_recovers_what_drift_cost_and_rollback_undoes_it(start: Start) -> None:
    service = start()
    before = air_of(service)
    service.device.offsets = DRIFTED
    drifted = air_of(service)
    assert drifted < before - 0.8
    steps: list[tuple[str, float]] = []
    result = service.client.recalibrate(count=2, progress=lambda name, share: steps.append((name, share)))
    assert (result.model_version, result.previous_version) == ("toy-1+r1", "toy-1")
    assert (result.pages_used, result.pages_held_back) == (2, 1)
    assert (result.angle_deg, result.coherence_before, result.coherence_after) == (0.5, 0.4, 0.9)
    assert result.air_after > result.air_before
    assert [share for _, share in steps] == sorted(share for _, share in steps)
    assert ("fit", pytest.approx(2 / 25 + 23 / 25 * 11 / 23)) in steps  # half of the fit, two pages read
    assert air_of(service) > 0.98 * before
    assert [(m.version, m.current) for m in service.client.models()] == [("toy-1", False), ("toy-1+r1", True)]
    assert service.client.describe().calibration_toml == "angle_deg = 0.5\n"
    assert service.client.rollback() == ("toy-1", "toy-1+r1")
    assert air_of(service) < before - 0.8
    with pytest.raises(BundleError, match="earlier model"):
        service.client.rollback()


def test_without_a_store_recalibration_goes_on_after_a_rollback_and_keeps_only_the_models_held(start: Start) -> None:
    service = start()
    assert service.client.recalibrate(count=2).model_version == "toy-1+r1"
    assert service.client.rollback() == ("toy-1", "toy-1+r1")
    versions = [service.client.recalibrate(count=2).model_version for _ in range(KEPT_MODELS + 1)]
    assert versions == [f"toy-1+r{number}" for number in range(2, KEPT_MODELS + 3)]
    kept = [model.decoder.bundle.path for model in service.plane.registry.models]
    assert sorted(kept[0].parent.iterdir()) == sorted(kept)
    service.recalibrator.close()
    assert not kept[0].parent.exists()


def test_recalibration_with_wrong_pilots_is_refused_and_the_old_model_stays(start: Start) -> None:
    service = start()
    as_it_was = service.source.shot

    def lying(timeout_s: float = 1.0, page: int | None = None) -> object:
        found = as_it_was(timeout_s, page)
        wrong = np.random.default_rng(1).integers(16, size=toy.PAGE).astype(np.uint8)
        return type(found)(found.pair, found.page_index, wrong)

    service.source.shot = lying  # type: ignore[method-assign,assignment]
    with pytest.raises(RecalibrationRefusedError, match="does not match"):
        service.client.recalibrate(count=3)
    service.source.shot = as_it_was  # type: ignore[method-assign]
    assert service.client.describe().model.version == "toy-1"
    assert [m.version for m in service.client.models()] == ["toy-1"]
    assert service.count("lightpage_recalibrations_total", result="refused") == 1


def test_recalibration_that_would_decode_worse_is_refused(start: Start) -> None:
    def worse(*arguments: object) -> RefitResult:
        good = toy.fit_references(*arguments)  # type: ignore[arg-type]
        return RefitResult({"homodyne": np.array([5.7, 0.7], np.float32)}, good.calibration_toml, good.report)

    service = start(fit=worse)
    with pytest.raises(RecalibrationRefusedError, match="model in service"):
        service.client.recalibrate(count=2)
    assert service.client.describe().model.version == "toy-1"


class DriftTracker(NoTracker):
    """Has learnt where the drifted device's offsets are."""

    def __init__(self, decoder: Decoder) -> None:
        references = toy.ToyDevice(DRIFTED).references()
        table: SamplingTable = {
            "reference_in_phase": references.in_phase.astype(np.float32),
            "reference_quadrature": references.quadrature.astype(np.float32),
        }
        super().__init__(decoder.with_table(table))


def test_a_page_whose_pilots_disagree_is_lost_and_not_answered(start: Start) -> None:
    service = start()
    pair = toy.ToyDevice().page(np.random.default_rng(5).integers(16, size=toy.PAGE).astype(np.uint8), 16)
    with pytest.raises(UnconfirmedPageError, match=r"frame pair: pilots: got 0\.00 of") as caught:
        service.client.decode(pair, 16)
    assert caught.value.reason is Reason.PILOTS_DISAGREE
    assert caught.value.recalibration_due
    count = service.plane.metrics.registry.get_sample_value
    assert count("lightpage_pages_lost_total", {"reason": "PILOTS_DISAGREE"}) == 1
    assert count("lightpage_recalibration_due") == 1
    assert count("lightpage_calls_total", {"method": "DecodeFrames", "code": "DATA_LOSS"}) == 1
    # a caller's own pilots may be wrong, and say nothing of the device
    service.client.decode(a_page()[1], 16)
    wrong = np.random.default_rng(8).integers(16, size=toy.PAGE).astype(np.uint8)
    with pytest.raises(UnconfirmedPageError) as caught:
        service.client.decode(a_page()[1], 16, pilots=KnownPilots(pilot_mask(toy.PROFILE), wrong, 16))
    assert not caught.value.recalibration_due
    assert count("lightpage_recalibration_due") == 0
    # the page after it is answered, and what its pilots confirm is told
    page = service.client.decode(a_page()[1], 16)
    assert not page.recalibration_due
    assert page.confirmed_bits == pytest.approx(page.claimed_bits, rel=0.15)
    assert page.image is None  # the toy knows no shift
    assert count("lightpage_recalibration_due") == 0


def test_a_lost_page_of_the_source_is_named_and_says_why_on_the_wire(start: Start) -> None:
    service = start()
    service.device.offsets = (230.0, 20.0)
    with grpc.insecure_channel(service.server.target) as channel, pytest.raises(grpc.RpcError) as caught:
        service.stub(channel).ReadPage(pb.ReadPageRequest(page=7), timeout=20)
    assert caught.value.code() == grpc.StatusCode.DATA_LOSS
    detail = pb.ErrorDetail.FromString(dict(caught.value.trailing_metadata())["lightpage-error-bin"])
    assert (detail.kind, detail.thing) == ("UnconfirmedPageError", "page 7 of toy:device: pilots")
    assert detail.reason == pb.LOSS_REASON_PILOTS_DISAGREE
    assert detail.recalibration_due


def test_a_re_fit_is_judged_against_what_the_tracker_makes_of_the_old_model(
    start: Start,
) -> None:
    def half_way(*arguments: object) -> RefitResult:
        good = toy.fit_references(*arguments)  # type: ignore[arg-type]
        table = {name: values - 8 for name, values in good.table.items()}
        return RefitResult(table, good.calibration_toml, good.report)

    tracked = start(fit=half_way, tracker=DriftTracker)
    tracked.device.offsets = DRIFTED
    with pytest.raises(RecalibrationRefusedError, match="model in service"):
        tracked.client.recalibrate(count=2)
    assert tracked.client.describe().model.version == "toy-1"
    untracked = start(fit=half_way)
    untracked.device.offsets = DRIFTED
    assert untracked.client.recalibrate(count=2).model_version == "toy-1+r1"


def test_a_recalibrated_model_keeps_the_threads_of_the_one_before(start: Start) -> None:
    service = start()
    service.client.recalibrate(count=2)
    assert [model.decoder.threads for model in service.plane.registry.models] == [1, 1]


@dataclass
class SlowFit:
    """A fit that waits for leave to go on."""

    entered: threading.Event
    go: threading.Event
    ended: threading.Event

    def __call__(
        self, bundle: object, pages: object, progress: Callable[[str, float], None], decoder: object
    ) -> object:
        self.entered.set()
        try:
            until = time.monotonic() + 20
            while not self.go.wait(0.02) and time.monotonic() < until:
                progress("wait", 0.1)
            return toy.fit_references(bundle, pages, progress, decoder)  # type: ignore[arg-type]
        finally:
            self.ended.set()


def slow_fit() -> SlowFit:
    return SlowFit(threading.Event(), threading.Event(), threading.Event())


def test_a_recalibration_that_the_end_of_the_service_cuts_off_says_so(start: Start) -> None:
    fit = slow_fit()
    service = start(fit=fit)  # type: ignore[arg-type]
    errors: list[BaseException] = []

    def call() -> None:
        try:
            service.client.recalibrate(count=2)
        except LightpageError as error:
            errors.append(error)

    caller = threading.Thread(target=call)
    caller.start()
    assert fit.entered.wait(10)
    service.server.stop(5.0)
    caller.join(10)
    assert [type(error) for error in errors] == [StoppingError]
    assert service.count("lightpage_recalibrations_total", result="dropped") == 1


def test_a_recalibration_that_is_stopped_reads_and_decodes_no_more_pages(start: Start) -> None:
    service, read = start(), list[int]()
    as_it_was = service.source.shot

    def leaving(timeout_s: float = 1.0, page: int | None = None) -> object:
        read.append(len(read))
        if len(read) == 2:
            service.recalibrator._stop.set()
        return as_it_was(timeout_s, page)

    service.source.shot = leaving  # type: ignore[method-assign,assignment]
    with pytest.raises(StoppingError):
        service.client.recalibrate(count=5)
    assert read == [0, 1]


def test_the_service_ends_in_time_beside_a_recalibration_that_does_not_stop(start: Start) -> None:
    entered, go = threading.Event(), threading.Event()

    def deaf(*arguments: object) -> RefitResult:
        entered.set()
        go.wait(20)
        return toy.fit_references(*arguments)  # type: ignore[arg-type]

    service = start(fit=deaf)
    with grpc.insecure_channel(service.server.target) as channel:
        call = service.stub(channel).Recalibrate(pb.RecalibrateRequest(source=pb.SourcePages(count=2)), timeout=20)
        assert next(call).progress.step
        assert entered.wait(10)
        begun = time.monotonic()
        service.server.stop(0.5)
        assert time.monotonic() - begun < 5
    go.set()
    assert wait_until(lambda: service.count("lightpage_recalibrations_total", result="dropped") == 1)
    assert [model.version for model in service.plane.registry.models] == ["toy-1"]


def test_a_second_recalibration_is_turned_away_and_the_first_ends_well(start: Start) -> None:
    fit = slow_fit()
    service = start(fit=fit)  # type: ignore[arg-type]
    results: list[object] = []
    first = threading.Thread(target=lambda: results.append(service.client.recalibrate(count=2)))
    first.start()
    assert fit.entered.wait(10)
    with LightpageClient(service.server.target) as second, pytest.raises(BusyError, match="recalibration"):
        second.recalibrate(count=2)
    assert (service.client.decode(a_page()[1], 16).symbols == a_page()[0]).all()  # decoding goes on beside it
    fit.go.set()
    first.join(10)
    assert len(results) == 1
    assert service.client.describe().model.version == "toy-1+r1"


def test_a_recalibration_whose_caller_leaves_is_dropped(start: Start) -> None:
    fit = slow_fit()
    service = start(fit=fit)  # type: ignore[arg-type]
    with grpc.insecure_channel(service.server.target) as channel:
        call = service.stub(channel).Recalibrate(pb.RecalibrateRequest(source=pb.SourcePages(count=2)), timeout=20)
        assert next(call).progress.step
        assert fit.entered.wait(10)
        call.cancel()
    assert fit.ended.wait(10)
    assert wait_until(lambda: service.count("lightpage_recalibrations_total", result="dropped") == 1)
    assert service.client.describe().model.version == "toy-1"
    fit.go.set()
    assert service.client.recalibrate(count=2).model_version == "toy-1+r1"


def test_a_rollback_during_recalibration_makes_its_result_out_of_date(start: Start) -> None:
    fit = slow_fit()
    service = start(fit=fit)  # type: ignore[arg-type]
    fit.go.set()
    service.client.recalibrate(count=2)
    fit.go.clear()
    fit.entered.clear()
    errors: list[Exception] = []

    def again() -> None:
        try:
            service.client.recalibrate(count=2)
        except RecalibrationRefusedError as error:
            errors.append(error)

    thread = threading.Thread(target=again)
    thread.start()
    assert fit.entered.wait(10)
    assert service.client.rollback()[0] == "toy-1"
    fit.go.set()
    thread.join(10)
    assert len(errors) == 1
    assert service.client.describe().model.version == "toy-1"


def test_a_change_of_model_that_cannot_be_noted_is_not_made(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(store=tmp_path / "store")
    store = service.plane.store
    assert store is not None
    assert service.client.recalibrate(count=2).model_version == "toy-1+r1"

    def full(*_: object) -> None:
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", full)
        with pytest.raises(BundleError, match="disk full"):
            service.client.rollback()
        assert service.client.describe().model.version == "toy-1+r1"
        with pytest.raises(BundleError, match="disk full"):
            service.client.recalibrate(count=2)
    assert service.client.describe().model.version == "toy-1+r1"
    assert service.count("lightpage_model_info", version="toy-1+r1") == 1
    assert sorted(path.name for path in store.folder.iterdir()) == ["current.json", "jobs.json", "toy-1+r1.zip"]
    assert store.last() == store.path_of("toy-1+r1")
    assert service.client.rollback()[0] == "toy-1"
    assert store.last() is None


def test_recalibration_from_a_recording_on_the_server(start: Start, tmp_path: Path) -> None:
    service = start()
    toy.write_toy_recording(tmp_path / "known.h5", toy.ToyDevice(DRIFTED), 16, 3)
    assert service.client.recalibrate(recording="known.h5").pages_used == 3
    for name in ("absent.h5", "../known.h5", str(tmp_path / "known.h5"), "", "x" * 300):
        with pytest.raises(InvalidInputError, match="recording"):
            service.client.recalibrate(recording=name)
    with pytest.raises(LimitError, match="at most 16"):
        service.client.recalibrate(count=17)


def test_pages_without_light_are_left_out_of_a_recalibration(start: Start, tmp_path: Path) -> None:
    service = start()
    toy.write_toy_recording(tmp_path / "dark.h5", toy.ToyDevice(DRIFTED), 16, 4)
    with h5py.File(tmp_path / "dark.h5", "r+") as file:
        file["in_phase"][1] = 0
    assert service.client.recalibrate(recording="dark.h5").pages_used == 3


def test_of_a_recording_on_the_server_the_first_pages_asked_for_are_used(start: Start, tmp_path: Path) -> None:
    service = start()
    symbols = toy.write_toy_recording(tmp_path / "long.h5", toy.ToyDevice(DRIFTED), 16, 18)
    with h5py.File(tmp_path / "long.h5", "r+") as file:
        file["symbols"][3:] = 15 - symbols[3:]
    with pytest.raises(LimitError, match="18, wanted at most 16"):
        service.client.recalibrate(recording="long.h5")
    with pytest.raises(LimitError, match="17, wanted at most 16"):
        service.client.recalibrate(recording="long.h5", count=17)
    result = service.client.recalibrate(recording="long.h5", count=3)
    assert (result.pages_used, result.pages_held_back) == (3, 2)
    toy.write_toy_recording(tmp_path / "short.h5", toy.ToyDevice(DRIFTED), 16, 2)
    with pytest.raises(RecordingError, match="2 pages, wanted at least 3"):
        service.client.recalibrate(recording="short.h5", count=3)


def test_another_devices_recording_on_the_server_is_refused_by_its_shape(start: Start, tmp_path: Path) -> None:
    service = start()
    toy.write_toy_recording(tmp_path / "narrow.h5", toy.ToyDevice(DRIFTED), 16, 2)
    with h5py.File(tmp_path / "narrow.h5", "r+") as file:
        for name in ("in_phase", "quadrature", "reference_in_phase", "reference_quadrature"):
            data = file[name][..., :90]
            del file[name]
            file[name] = data
    with pytest.raises(RecordingError, match="in_phase: got frames of 64 x 90 pixels"):
        service.client.recalibrate(recording="narrow.h5")


def test_a_swap_under_load_loses_no_request(start: Start) -> None:
    service = start()
    stop, answers, errors = threading.Event(), [], []
    symbols, pair = a_page()

    def load() -> None:
        with LightpageClient(service.server.target) as client:
            until = time.monotonic() + 20
            while not stop.is_set() and time.monotonic() < until:
                try:
                    answers.append(client.decode(pair, 16))
                except LightpageError as error:
                    errors.append(error)

    threads = [threading.Thread(target=load) for _ in range(3)]
    for thread in threads:
        thread.start()
    versions = ["toy-1+r1", "toy-1+r2", "toy-1+r3"]
    for version in versions:
        assert service.client.recalibrate(count=2).model_version == version
        assert wait_until(lambda version=version: answers[-1].model_version == version)  # type: ignore[misc]
    service.client.rollback()
    assert wait_until(lambda: answers[-1].model_version == "toy-1+r2")
    stop.set()
    for thread in threads:
        thread.join(10)
    assert errors == []
    assert {answer.model_version for answer in answers} >= set(versions)
    assert all((answer.symbols == symbols).all() for answer in answers)


def test_an_unforeseen_error_is_internal_and_tells_nothing_of_the_inside(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start()

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("secret path /srv/keys")

    monkeypatch.setattr(service.plane, "read_page", broken)
    with pytest.raises(LightpageError, match="INTERNAL") as error:
        service.client.read_page()
    assert "secret" not in str(error.value)


def test_a_port_that_is_taken_is_named(start: Start, toy_zip: Path) -> None:
    service = start()
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)))
    address = service.server.target
    with pytest.raises(InvalidInputError, match=address):
        LightpageServer(plane, Recalibrator(plane, toy.fit_references), address).start()


def test_a_service_on_a_unix_socket_is_found_there(toy_zip: Path, tmp_path: Path) -> None:
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)))
    address = f"unix:{tmp_path}/s"
    with LightpageServer(plane, Recalibrator(plane, toy.fit_references), address) as server:
        assert server.target == address
        with LightpageClient(server.target) as client:
            assert client.describe().model.version == "toy-1"


def test_a_service_without_a_source_says_so(toy_zip: Path) -> None:
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)))
    server = LightpageServer(plane, Recalibrator(plane, toy.fit_references))
    with server, LightpageClient(server.target) as client:
        assert client.describe().source == ""
        with pytest.raises(SourceError, match="--source"):
            client.read_page()
        with pytest.raises(SourceError, match="--source"):
            client.recalibrate(count=2)
        with pytest.raises(SourceError, match="--recordings"):
            client.recalibrate(recording="R.h5")


def test_nobody_at_the_address_is_said_plainly() -> None:
    with LightpageClient("127.0.0.1:9", timeout_s=3) as client, pytest.raises(LightpageError, match="no connection"):
        client.describe()
