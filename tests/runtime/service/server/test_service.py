"""The running service: what it answers, what it refuses, and that it keeps nothing behind."""

import errno
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import grpc
import h5py
import numpy as np
import pytest

from lightpage.errors import InvalidInputError, NoSourceError, Reason, StoreError, UnconfirmedPageError
from lightpage.page.symbols import pilot_mask
from lightpage.runtime.client.outgoing import KnownPilots
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.acquisition.source import Shot, open_source
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.server.server import LightpageServer
from tests.runtime import toy
from tests.runtime.service.stage import Refused, Running, Start, a_page, header, parts, raised, refused, until_told
from tests.waiting import eventually

SIZE = toy.SHAPE[0] * toy.SHAPE[1]
INVALID = grpc.StatusCode.INVALID_ARGUMENT


def sent(service: Running, *messages: pb.DecodeFramesRequest) -> Refused:
    """How a DecodeFrames with these messages fails."""
    return refused(lambda: service.stub.DecodeFrames(iter(messages), timeout=20))


def beginning(**changes: Any) -> pb.DecodeFramesRequest:
    return pb.DecodeFramesRequest(header=header(**changes))


def chunk(size: int) -> pb.DecodeFramesRequest:
    return pb.DecodeFramesRequest(chunk=bytes(size))


def test_the_service_describes_itself(start: Start) -> None:
    description = start(limits=Limits(replay_s=7.0, range_pages=9)).client.describe()
    assert (description.model.version, description.model.current) == ("toy-1", True)
    assert (description.frame_shape, description.page_shape) == (toy.SHAPE, toy.PAGE)
    assert (description.frame_dtype, description.bit_depth) == ("uint8", 8)
    assert (description.source, description.source_levels, description.default_levels) == ("toy:device", 16, 16)
    assert description.profile_toml == toy.PROFILE.to_toml()
    assert description.calibration_toml == toy.manifest().calibration
    assert (description.pilot_mask == pilot_mask(toy.PROFILE)).all()
    assert description.limits is not None
    assert (description.limits.replay_s, description.limits.range_pages) == (7.0, 9)
    assert (description.limits.shared_bytes, description.user_bytes_per_page) == (0, 0)


def test_a_sent_pair_comes_back_as_the_local_decoder_would_decode_it(service: Running, decoder: Decoder) -> None:
    symbols, pair = a_page()
    here = decoder.decode(pair, 16)
    there = service.client.frames.decode(pair, 16, want_concentration=True, want_phase=True)
    assert (there.symbols == symbols).all()
    for name in ("symbols", "confidence", "concentration", "phase"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
    assert there.piston_rad == pytest.approx(here.piston_rad)
    assert (there.model_version, there.levels) == ("toy-1", 16)
    assert (there.frames, there.replayed, there.recalibration_reasons) == ((), False, ())
    assert 0 < there.timings.inference_s < there.timings.decode_s < there.timings.total_s
    assert there.timings.steps == 0  # a network's bundle
    assert service.plane.received.used == 0


def test_what_is_asked_of_a_pair_is_done_and_no_more_is_sent(service: Running) -> None:
    pair = a_page(64)[1]
    exact, coarse = service.client.frames.decode(pair, 64), service.client.frames.decode(pair, 64, quantised=True)
    assert (coarse.concentration, coarse.phase) == (None, None)
    assert set(np.unique(coarse.confidence * 255 % 1)) == {0}
    assert (coarse.confidence <= exact.confidence).all()
    assert (exact.confidence - coarse.confidence).max() <= 1 / 255

    assert exact.symbols.max() > 16
    assert service.stub.DecodeFrames(parts(a_page()[1], options=pb.DecodeOptions()), timeout=20).levels == 16
    assert service.client.pages.read(3).levels == 16

    symbols = np.random.default_rng(5).integers(16, size=toy.PAGE).astype(np.uint8)
    mask = np.zeros(toy.PAGE, bool)
    mask[::4, ::6] = True
    pair = toy.ToyDevice().page(symbols, 16, 2.0)
    assert (service.client.frames.decode(pair, 16, pilots=KnownPilots(mask, symbols, 16)).symbols == symbols).all()

    symbols, pair = a_page()
    assert (service.client.frames.decode(raised(pair, 6), 16, black_level=6).symbols == symbols).all()
    for level in (255, 256):
        answer = sent(service, beginning(black_level=level))
        assert (answer.code, answer.subject) == (INVALID, "black_level")


_, PAIR = a_page()


BAD_OPTIONS = {
    "levels": pb.DecodeOptions(levels=999),
    "confidence_format": pb.DecodeOptions(levels=16, confidence_format=7),  # type: ignore[arg-type]
    "tracking": pb.DecodeOptions(levels=16, tracking=7),  # type: ignore[arg-type]
    "session": pb.DecodeOptions(levels=16, session="x" * 1025),
}


def test_bad_options_are_named_before_a_frame_is_sent_or_a_page_is_read(start: Start) -> None:
    service = start()
    for name, options in BAD_OPTIONS.items():
        for answer in (
            sent(service, beginning(options=options)),
            refused(lambda asked=options: service.stub.ReadPage(pb.ReadPageRequest(options=asked), timeout=20)),  # type: ignore[misc]
        ):
            assert (answer.code, answer.subject) == (INVALID, name)
            assert answer.told["BadRequest"].field_violations[0].field == name
    for pilots in (pb.Pilots(mask=b"abc"), pb.Pilots(mask=b"\2" + bytes(383)), pb.Pilots(mask=bytes(384), values=b"a")):
        assert sent(service, beginning(pilots=pilots)).subject == "pilots"
    assert service.client.frames.decode(PAIR, 16, session="x" * 1024).levels == 16
    assert service.client.pages.read().page == 0


def test_a_broken_stream_is_the_callers_fault_and_named(service: Running) -> None:
    begin = beginning()
    cases: list[tuple[list[pb.DecodeFramesRequest], str, str]] = [
        ([], "MALFORMED", "no header"),
        ([chunk(3)], "MALFORMED", "no header"),
        ([begin], "FRAME_FORMAT", "0 bytes"),
        ([begin, chunk(SIZE)], "FRAME_FORMAT", f"{SIZE} bytes"),
        ([begin, chunk(2 * SIZE + 1)], "FRAME_FORMAT", f"{2 * SIZE} bytes"),
        ([begin, chunk(2 * SIZE), chunk(1)], "FRAME_FORMAT", f"{2 * SIZE} bytes"),
        ([begin, begin], "MALFORMED", "a second header"),
        ([begin, pb.DecodeFramesRequest()], "MALFORMED", "an empty message"),
        ([beginning(pixel_type=77)], "INVALID_VALUE", "77"),
        ([beginning(pixel_type=pb.PIXEL_TYPE_UINT16)], "FRAME_FORMAT", "uint16"),
        ([beginning(bit_depth=4, black_level=100)], "FRAME_FORMAT", "4 bits"),
        ([beginning(rows_px=63)], "FRAME_FORMAT", "63x96"),
    ]
    for messages, reason, got in cases:
        answer = sent(service, *messages)
        assert (answer.code, answer.reason) == (INVALID, reason), messages
        assert got in answer.text
    assert service.plane.received.used == 0


def test_oversize_requests_are_refused_before_anything_is_allocated(start: Start) -> None:
    service = start(limits=Limits(pair_bytes=1 << 20, chunk_bytes=1 << 16, message_bytes=1 << 20))
    for messages, got in (
        ([beginning(rows_px=60_000, columns_px=60_000)], "7200000000 bytes"),
        ([beginning(), chunk((1 << 16) + 1)], f"{(1 << 16) + 1} bytes"),
    ):
        answer = sent(service, *messages)
        assert (answer.code, got in answer.error.got) == (grpc.StatusCode.RESOURCE_EXHAUSTED, True)
    assert (service.client.frames.decode(PAIR, 16).symbols == a_page()[0]).all()


def test_senders_who_stand_still_cost_the_others_nothing_and_leave_nothing_behind(start: Start) -> None:
    service, over = start(), threading.Event()
    begun = [beginning(), chunk(100)]
    calls = [service.stub.DecodeFrames.future(until_told(begun, over), timeout=60) for _ in range(40)]
    eventually(lambda: service.plane.received.used == 40 * 100)
    assert (service.client.frames.decode(PAIR, 16).symbols == a_page()[0]).all()
    assert service.count("lightpage_calls_in_flight") == 40
    for call in calls:
        call.cancel()
    over.set()
    eventually(lambda: service.count("lightpage_calls_in_flight") == 0)
    eventually(lambda: service.plane.received.used == 0)
    assert service.count("lightpage_pages_total", model_version="toy-1") == 1


def test_waiting_for_a_slot_is_not_stalling(start: Start) -> None:
    service = start(limits=Limits(concurrent_decodes=1, receive_s=0.1, stall_s=0.1))
    with ThreadPoolExecutor(1) as pool:
        with service.plane.decodes.held(Caller()):
            waiting = pool.submit(service.client.frames.decode, PAIR, 16)
            eventually(lambda: service.plane.decodes.queued == 1)
            threading.Event().wait(0.2)
            assert not waiting.done()
        assert (waiting.result(60).symbols == a_page()[0]).all()


def test_a_damaged_page_of_the_source_is_the_services_own_fault(start: Start, tmp_path: Path) -> None:
    path = tmp_path / "source.h5"
    toy.write_toy_recording(path, toy.ToyDevice(), 16, 4)
    with h5py.File(path, "r+") as file:
        file["quadrature"][1] = 0
    service = start(source=open_source(f"recording:{path}"))
    stub, recalibration = service.stub, pb.RecalibrateRequest(source=pb.SourcePages(pages=(0, 1)))
    for answer, subject in (
        (refused(lambda: stub.ReadPage(pb.ReadPageRequest(page=1), timeout=20)), "page 1 of recording:source.h5"),
        (refused(lambda: stub.Recalibrate(recalibration, timeout=20)), "known page 1"),
    ):
        assert (answer.code, answer.reason) == (grpc.StatusCode.FAILED_PRECONDITION, "SOURCE_BROKEN")
        assert answer.subject.startswith(subject)
        assert str(tmp_path) not in answer.text
    assert refused(lambda: stub.ReadPage(pb.ReadPageRequest(page=9), timeout=20)).reason == "NO_SUCH_PAGE"
    assert service.client.describe().source == "recording:source.h5"


def test_a_page_whose_pilots_disagree_is_lost_and_not_answered(start: Start) -> None:
    service = start()
    strange = toy.ToyDevice().page(np.random.default_rng(5).integers(16, size=toy.PAGE).astype(np.uint8), 16)
    with pytest.raises(UnconfirmedPageError) as caught:
        service.client.frames.decode(strange, 16)
    assert caught.value.subject == "frame pair: pilots"
    assert (caught.value.reason, caught.value.recalibration_due) == (Reason.PILOTS_DISAGREE, True)
    assert service.count("lightpage_recalibration_due") == 1
    assert service.count("lightpage_calls_total", method="DecodeFrames", code="DATA_LOSS") == 1
    service.reading(lambda shot: Shot(strange, shot.page_index))
    with pytest.raises(UnconfirmedPageError) as caught:
        service.client.pages.read(7)
    assert caught.value.subject == "page 7 of toy:device: pilots"
    # a caller's own pilots may be wrong, and say nothing of the device
    service.client.frames.decode(PAIR, 16)
    wrong = np.random.default_rng(8).integers(16, size=toy.PAGE).astype(np.uint8)
    with pytest.raises(UnconfirmedPageError) as caught:
        service.client.frames.decode(PAIR, 16, pilots=KnownPilots(pilot_mask(toy.PROFILE), wrong, 16))
    assert not caught.value.recalibration_due
    assert service.count("lightpage_recalibration_due") == 0
    page = service.client.frames.decode(PAIR, 16)
    assert page.confirmed_bits == pytest.approx(page.claimed_bits, rel=0.15)


def test_a_server_is_found_where_it_is_and_says_what_it_lacks(service: Running, start: Start, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError) as error:
        LightpageServer(service.plane, service.recalibrator, service.server.target).start()
    assert service.server.target in error.value.subject

    service = start(address=f"unix:{tmp_path}/s", source=None, recordings=None)
    assert service.server.target == f"unix:{tmp_path}/s"
    assert service.client.describe().source == ""
    asked: list[Callable[[], object]] = [
        service.client.pages.read,
        lambda: service.client.jobs.recalibrate(count=2),
        lambda: service.client.jobs.start(count=2),
        lambda: service.client.jobs.recalibrate(recording="R.h5"),
    ]
    for call in asked:
        with pytest.raises(NoSourceError):
            call()


def test_a_recalibration_without_any_folder_is_refused_before_it_begins(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = Mock(side_effect=FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp']"))
    service = start()
    monkeypatch.setattr(tempfile, "mkdtemp", none)
    with pytest.raises(StoreError):
        service.recalibrator.check_start()
    with pytest.raises(StoreError):
        service.client.jobs.start(count=2)
    assert service.client.jobs.list() == []
