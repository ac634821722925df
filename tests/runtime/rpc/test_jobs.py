"""Recalibrations as jobs over the wire: they survive their callers, and frames that are sent serve as a recording."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import grpc
import numpy as np
import pytest
from google.rpc import error_details_pb2, status_pb2

from lightpage.errors import (
    BlackFrameError,
    BusyError,
    FrameError,
    InvalidInputError,
    LightpageError,
    LimitError,
    PageError,
    RecalibrationRefusedError,
)
from lightpage.page.symbols import pilot_mask
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from runtime.bundle.bundle import Bundle
from runtime.client.answers import JobInfo, JobState
from runtime.client.client import LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.errors import (
    JobCancelledError,
    MalformedError,
    NoSourceError,
    NoSuchJobError,
    OtherModelError,
    OverloadedError,
    StalledError,
)
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.recalibration.known_pages import KnownPages, read_recorded
from runtime.recalibration.outcome import Refit, RefitResult
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.limits import Limits
from runtime.service.monitor import Monitor
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.service.self_calibration import SelfCalibration, SelfCalibrationSettings
from runtime.service.store import ModelStore
from runtime.wire.status import STATUS_KEY, error_of
from tests.runtime import toy
from tests.runtime.rpc.test_service import slow_fit, wait_until

DRIFTED = (150.0, 62.0)
Parts = Sequence[pb.RecalibrateFramesRequest]


@dataclass
class Service:
    plane: DataPlane
    recalibrator: Recalibrator
    server: LightpageServer
    source: toy.ToySource
    client: LightpageClient
    channels: list[grpc.Channel] = field(default_factory=list)

    @property
    def version(self) -> str:
        return self.plane.registry.current.version

    def stub(self) -> pb_grpc.LightpageStub:
        self.channels.append(grpc.insecure_channel(self.server.target))
        return pb_grpc.LightpageStub(self.channels[-1])

    def end(self) -> None:
        self.client.close()
        for channel in self.channels:
            channel.close()
        self.server.stop(0.5)

    def last(self, job: JobInfo) -> JobInfo:
        """The job once it has ended."""
        *_, end = self.client.watch_job(job.id, 20)
        return end


Start = Callable[..., Service]


@pytest.fixture
def start(toy_zip: Path, tmp_path: Path) -> Iterator[Start]:
    running: list[Service] = []

    def begin(
        fit: Refit = toy.fit_references,
        store: Path | None = None,
        limits: Limits | None = None,
        address: str = "127.0.0.1:0",
        source: bool = True,
    ) -> Service:
        device = toy.ToySource(toy.ToyDevice())
        registry = ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1))
        models = None if store is None else ModelStore(store, registry.current.decoder.bundle)
        if models is not None and (path := models.last()) is not None:
            registry.swap(Decoder.load(path, 1))
        plane = DataPlane(registry, device if source else None, models, limits, monitor=Monitor())
        recalibrator = Recalibrator(plane, fit, tmp_path)
        server = LightpageServer(plane, recalibrator, address).start()
        running.append(Service(plane, recalibrator, server, device, LightpageClient(server.target, timeout_s=20)))
        return running[-1]

    yield begin
    for service in running:
        service.end()


def known(count: int = 3, levels: int = 16, offsets: tuple[float, float] = DRIFTED) -> KnownPages:
    device = toy.ToyDevice(offsets)
    symbols = toy.symbols_of(levels, 11, count)
    pairs = tuple(device.page(page, levels, 0.3) for page in symbols)
    return KnownPages(pairs, tuple(symbols), levels, device.references())


def send(client: LightpageClient, pages: KnownPages, **options: object) -> JobInfo:
    assert pages.references is not None
    given = {"levels": pages.levels, "pilot_mask": pages.pilot_mask, **options}
    return client.recalibrate_frames(pages.pairs, pages.symbols, pages.references, **given)  # type: ignore[arg-type]


def bytes_of(pair: FramePair) -> bytes:
    return pair.in_phase.tobytes() + pair.quadrature.tobytes()


def header(**changes: object) -> pb.RecalibrateFramesRequest:
    usual = {"rows_px": 64, "columns_px": 96, "pixel_type": pb.PIXEL_TYPE_UINT8, "bit_depth": 8}
    return pb.RecalibrateFramesRequest(
        header=pb.RecalibrateFramesHeader(**{**usual, "levels": 16, "pages": 2, **changes})  # type: ignore[arg-type]
    )


def reference(data: bytes) -> pb.RecalibrateFramesRequest:
    return pb.RecalibrateFramesRequest(reference=data)


def symbols(data: bytes) -> pb.RecalibrateFramesRequest:
    return pb.RecalibrateFramesRequest(symbols=data)


def chunk(data: bytes) -> pb.RecalibrateFramesRequest:
    return pb.RecalibrateFramesRequest(chunk=data)


PAGES = known(2)
assert PAGES.references is not None
REFERENCE = reference(bytes_of(PAGES.references))
SYMBOLS = [symbols(page.tobytes()) for page in PAGES.symbols]
FRAMES = [chunk(bytes_of(pair)) for pair in PAGES.pairs]
ALL = [header(), REFERENCE, SYMBOLS[0], FRAMES[0], SYMBOLS[1], FRAMES[1]]
PAIR_BYTES = 2 * 64 * 96


def test_a_job_survives_its_caller(start: Start) -> None:
    fit = slow_fit()
    service = start(fit)
    with LightpageClient(service.server.target) as caller:
        job = caller.start_recalibration(count=2, correlation_id="night shift")
    assert fit.entered.wait(10)
    assert (job.state, job.pages_of, job.correlation_id) == (JobState.RUNNING, "source", "night shift")
    assert (job.ended_s, job.result, job.error) == (None, None, None)
    assert abs(job.created_s - time.time()) < 60
    fit.go.set()
    end = service.last(job)
    assert (end.id, end.state, end.error, end.correlation_id) == (job.id, JobState.DONE, None, "night shift")
    assert end.result is not None
    assert (end.result.model_version, end.result.pages_used) == ("toy-1+r1", 2)
    assert end.ended_s is not None
    assert service.version == "toy-1+r1"
    assert service.client.jobs() == [end]


def test_a_watch_tells_each_change_and_holds_no_thread(start: Start) -> None:
    fit = slow_fit()
    service = start(fit, limits=Limits(concurrent_calls=2))
    job = service.client.start_recalibration(count=2)
    assert fit.entered.wait(10)
    told: list[list[JobInfo]] = [[] for _ in range(6)]

    def watch(one: list[JobInfo]) -> None:
        with LightpageClient(service.server.target) as client:
            one.extend(client.watch_job(job.id, 20))

    threads = [threading.Thread(target=watch, args=(one,)) for one in told]
    for thread in threads:
        thread.start()
    assert wait_until(lambda: all(told))
    assert service.client.job(job.id).state is JobState.RUNNING  # there is room for calls beside them
    fit.go.set()
    for thread in threads:
        thread.join(10)
    for one in told:
        assert one[0].state is JobState.RUNNING
        assert {job.state for job in one[1:-1]} <= {JobState.RUNNING}
        assert one[-1].state is JobState.DONE
        assert [job.fraction for job in one] == sorted(job.fraction for job in one)
    assert wait_until(lambda: service.plane.metrics.registry.get_sample_value("lightpage_calls_in_flight") == 0)


def test_an_ended_job_is_watched_in_one_message_and_an_unknown_one_is_not_found(start: Start) -> None:
    service = start()
    end = service.last(service.client.start_recalibration(count=2))
    assert list(service.client.watch_job(end.id, 20)) == [end]
    for call in (service.client.job, service.client.cancel_job, lambda id_: list(service.client.watch_job(id_, 5))):
        with pytest.raises(NoSuchJobError):
            call("no-such-job")
    with pytest.raises(grpc.RpcError) as caught:
        service.stub().GetJob(pb.GetJobRequest(), timeout=20)
    assert caught.value.code() == grpc.StatusCode.NOT_FOUND


def test_a_cancelled_job_changes_nothing_and_makes_room(start: Start) -> None:
    fit = slow_fit()
    service = start(fit)
    job = service.client.start_recalibration(count=2)
    assert fit.entered.wait(10)
    cancelled = service.client.cancel_job(job.id)
    assert cancelled.state is JobState.CANCELLED
    assert isinstance(cancelled.error, JobCancelledError)
    assert service.version == "toy-1"
    again = service.client.cancel_job(job.id)
    assert (again.state, again.ended_s) == (JobState.CANCELLED, cancelled.ended_s)
    fit.go.set()
    done = service.last(service.client.start_recalibration(count=2))
    assert done.state is JobState.DONE
    assert service.client.cancel_job(done.id) == done
    assert service.version == "toy-1+r1"
    count = service.plane.metrics.registry.get_sample_value
    assert count("lightpage_recalibrations_total", {"result": "dropped"}) == 1


def test_a_second_one_is_told_which_runs_whoever_began_it(start: Start) -> None:
    fit = slow_fit()
    service = start(fit)
    call = service.stub().Recalibrate(pb.RecalibrateRequest(source=pb.SourcePages(count=2)), timeout=20)
    assert next(call).progress.step
    assert fit.entered.wait(10)
    (running,) = service.client.jobs()
    assert (running.state, running.pages_of) == (JobState.RUNNING, "source")
    for second in (
        lambda: service.client.start_recalibration(count=2),
        lambda: service.client.recalibrate(count=2),
        lambda: send(service.client, PAGES),
    ):
        with pytest.raises(BusyError) as caught:
            second()
        assert caught.value.job == running.id
    with pytest.raises(grpc.RpcError) as refused:
        service.stub().StartRecalibration(pb.StartRecalibrationRequest(source=pb.SourcePages(count=2)), timeout=20)
    assert refused.value.code() == grpc.StatusCode.ABORTED
    status = status_pb2.Status.FromString(dict(refused.value.trailing_metadata())[STATUS_KEY])
    info = error_details_pb2.ErrorInfo()
    assert status.details[0].Unpack(info)
    assert (info.reason, dict(info.metadata)) == ("RECALIBRATION_RUNS", {"job": running.id})
    assert len(service.client.jobs()) == 1
    service.client.cancel_job(running.id)  # also one with a caller, who hears why it ended
    with pytest.raises(grpc.RpcError) as ended:
        list(call)
    assert isinstance(error_of(ended.value, "x"), JobCancelledError)


def test_a_job_whose_caller_follows_it_ends_with_the_call(start: Start) -> None:
    fit = slow_fit()
    service = start(fit)
    call = service.stub().Recalibrate(pb.RecalibrateRequest(source=pb.SourcePages(count=2)), timeout=20)
    assert next(call).progress.step
    assert fit.entered.wait(10)
    call.cancel()
    assert service.last(service.client.jobs()[0]).state is JobState.CANCELLED


def test_self_calibrations_are_jobs_too(start: Start) -> None:
    service = start()
    monitor = service.plane.monitor
    assert monitor is not None
    calibration = SelfCalibration(service.plane, monitor, service.recalibrator, SelfCalibrationSettings())
    assert calibration._recalibrated().version == "toy-1+r1"
    (job,) = service.client.jobs()
    assert (job.state, job.pages_of) == (JobState.DONE, "source")


def test_results_are_kept_over_a_restart(start: Start, tmp_path: Path) -> None:
    store = tmp_path / "store"
    service = start(store=store)
    done = service.last(service.client.start_recalibration(count=2))
    second = service.last(service.client.start_recalibration(pages=[1, 2, 3]))
    service.end()
    again = start(store=store)
    assert [job.id for job in again.client.jobs()] == [second.id, done.id]
    assert again.client.job(done.id) == done
    assert again.version == service.version


def test_a_refused_job_says_why_as_a_call_would(start: Start) -> None:
    service = start()
    true_shot = service.source.shot

    def liar(timeout_s: float = 1.0, page: int | None = None) -> object:
        shot = true_shot(timeout_s, page)
        wrong = np.random.default_rng(page or 0).integers(16, size=toy.PAGE).astype(np.uint8)
        return type(shot)(shot.pair, shot.page_index, wrong)

    service.source.shot = liar  # type: ignore[method-assign,assignment]
    end = service.last(service.client.start_recalibration(pages=[1, 2, 3]))
    assert end.state is JobState.REFUSED
    assert isinstance(end.error, RecalibrationRefusedError)
    message = service.stub().GetJob(pb.GetJobRequest(id=end.id), timeout=20)
    assert message.refusal.code == grpc.StatusCode.FAILED_PRECONDITION.value[0]
    assert message.refusal.reason == pb.ERROR_REASON_RECALIBRATION_REFUSED
    assert service.version == "toy-1"


def test_what_fails_later_fails_the_job_and_what_is_known_at_once_the_call(start: Start, tmp_path: Path) -> None:
    service = start()
    end = service.last(service.client.start_recalibration(pages=[1]))
    toy.write_toy_recording(tmp_path / "short.h5", toy.ToyDevice(), 16, 2)
    assert end.state is JobState.FAILED
    end = service.last(service.client.start_recalibration(recording="short.h5", count=3))
    assert (end.state, end.pages_of) == (JobState.FAILED, "recording short.h5")
    assert isinstance(end.error, InvalidInputError)
    for options, kind in (
        ({"count": 17}, LimitError),
        ({"recording": "absent.h5"}, InvalidInputError),
        ({"recording": "../short.h5"}, InvalidInputError),
    ):
        with pytest.raises(kind):
            service.client.start_recalibration(**options)
    with pytest.raises(grpc.RpcError) as caught:
        service.stub().StartRecalibration(pb.StartRecalibrationRequest(), timeout=20)
    assert caught.value.code() == grpc.StatusCode.INVALID_ARGUMENT
    with pytest.raises(NoSourceError):
        start(source=False).client.start_recalibration(count=2)
    assert len(service.client.jobs()) == 2


def test_the_model_in_service_must_be_the_one_expected(start: Start) -> None:
    service = start()
    for call in (
        lambda: service.client.start_recalibration(count=2, expected_version="toy-0"),
        lambda: service.client.recalibrate(count=2, expected_version="toy-0"),
        lambda: send(service.client, PAGES, expected_version="toy-0"),
    ):
        with pytest.raises(OtherModelError) as caught:
            call()
        assert caught.value.got == "toy-1"
    assert service.client.jobs() == []
    assert service.client.recalibrate(count=2, expected_version="toy-1").model_version == "toy-1+r1"
    assert service.last(send(service.client, PAGES, expected_version="toy-1+r1")).state is JobState.DONE


def test_a_model_that_changes_while_pages_are_read_is_not_the_one_expected(start: Start) -> None:
    service = start()
    service.client.recalibrate(count=2)
    true_shot = service.source.shot

    def changing(timeout_s: float = 1.0, page: int | None = None) -> object:
        if service.version != "toy-1":
            service.client.rollback()
        return true_shot(timeout_s, page)

    service.source.shot = changing  # type: ignore[method-assign,assignment]
    end = service.last(service.client.start_recalibration(count=2, expected_version="toy-1+r1"))
    assert end.state is JobState.FAILED
    assert isinstance(end.error, OtherModelError)
    assert service.version == "toy-1"


def test_a_watch_goes_on_by_itself_over_a_restart_of_the_service(start: Start, tmp_path: Path) -> None:
    fit = slow_fit()
    service = start(fit, store=tmp_path / "store")
    job, told = service.client.start_recalibration(count=2), list[JobInfo]()
    assert fit.entered.wait(10)

    def watch() -> None:
        with LightpageClient(service.server.target) as client:
            told.extend(client.watch_job(job.id, 30))

    thread = threading.Thread(target=watch)
    thread.start()
    assert wait_until(lambda: len(told) > 0)
    service.server.stop(0.5)
    start(store=tmp_path / "store", address=f"127.0.0.1:{service.server.port}")
    thread.join(20)
    assert told[-1].state is JobState.INTERRUPTED


def test_a_watch_waits_for_nobody_it_has_never_heard_and_not_beyond_its_time(start: Start) -> None:
    with LightpageClient("127.0.0.1:9") as nobody, pytest.raises(LightpageError, match="no connection"):
        list(nobody.watch_job("x", 20))
    fit = slow_fit()
    service = start(fit)
    job = service.client.start_recalibration(count=2)
    assert fit.entered.wait(10)
    with pytest.raises(LightpageError, match="deadline"):
        list(service.client.watch_job(job.id, 0.5))
    assert service.client.job(job.id).state is JobState.RUNNING


@pytest.mark.parametrize("own_mask", [False, True])
def test_frames_that_are_sent_give_what_the_same_pages_of_a_recording_give(
    own_mask: bool, start: Start, tmp_path: Path
) -> None:
    toy.write_toy_recording(tmp_path / "known.h5", toy.ToyDevice(DRIFTED), 16, 4)
    one, other = start(), start(source=False)
    recorded = one.last(one.client.start_recalibration(recording="known.h5"))
    with Recording.open(tmp_path / "known.h5") as recording:
        pages = read_recorded(recording, range(4))
    mask = pilot_mask(toy.PROFILE) if own_mask else None
    job = send(other.client, pages, pilot_mask=mask, correlation_id="sent")
    sent = other.last(job)
    assert (sent.pages_of, sent.correlation_id, recorded.pages_of) == ("frames", "sent", "recording known.h5")
    assert sent.result is not None
    assert recorded.result is not None
    for name in ("model_version", "previous_version", "pages_used", "pages_held_back", "air_before", "air_after"):
        assert getattr(sent.result, name) == getattr(recorded.result, name)
    assert sent.result.air_after > sent.result.air_before + 0.5
    bundles = [service.plane.registry.current.decoder.bundle for service in (one, other)]
    assert bundles[0].files == bundles[1].files
    assert other.plane.received.used == 0


def test_the_black_level_is_taken_off_all_frames(start: Start) -> None:
    service, seen = start(source=False), list[KnownPages]()

    def fit(bundle: Bundle, pages: KnownPages, *rest: object) -> RefitResult:
        seen.append(pages)
        return toy.fit_references(bundle, pages, *rest)  # type: ignore[arg-type]

    service.recalibrator._fit = fit  # type: ignore[assignment]
    pages = known(2, offsets=(125.0, 82.0))

    def raised(pair: FramePair) -> FramePair:
        return FramePair(*(np.minimum(frame, 200) + np.uint8(20) for frame in (pair.in_phase, pair.quadrature)))

    references = raised(pages.references)  # type: ignore[arg-type]
    brighter = KnownPages(tuple(map(raised, pages.pairs)), pages.symbols, 16, references)
    assert service.last(send(service.client, brighter, black_level=20)).state is JobState.DONE
    assert (seen[0].references.in_phase == 125).all()  # type: ignore[union-attr]
    assert (seen[0].pairs[0].quadrature == np.minimum(pages.pairs[0].quadrature, 200)).all()


def test_dark_frames_are_left_out_and_too_many_are_the_callers_fault(start: Start) -> None:
    service, pages = start(), known(4)
    dark = FramePair(*2 * (np.zeros(toy.SHAPE, np.uint8),))
    one_dark = KnownPages((pages.pairs[0], dark, *pages.pairs[2:]), pages.symbols, 16, pages.references)
    done = service.last(send(service.client, one_dark)).result
    assert done is not None
    assert done.pages_used == 3
    cases: list[tuple[KnownPages, type[LightpageError], str]] = [
        (KnownPages((pages.pairs[0], dark, dark), pages.symbols[:3], 16, pages.references), BlackFrameError, "page 2"),
        (KnownPages(pages.pairs, pages.symbols, 16, dark), BlackFrameError, "reference"),
        (KnownPages(2 * pages.pairs[:1], pages.symbols[:2], 16, pages.references), InvalidInputError, "the frames of"),
    ]
    for bad, kind, named in cases:
        with pytest.raises(kind, match=named):
            send(service.client, bad)
    assert len(service.client.jobs()) == 1
    assert service.plane.received.used == 0


def flags(*values: int) -> bytes:
    mask = pilot_mask(toy.PROFILE).astype(np.uint8).reshape(-1)
    mask[: len(values)] = values
    return mask.tobytes()


WRONG: dict[str, tuple[Parts, type[LightpageError]]] = {
    "nothing": ([], MalformedError),
    "no header": (ALL[1:], MalformedError),
    "two headers": ([ALL[0], *ALL], MalformedError),
    "an empty message": ([*ALL[:2], pb.RecalibrateFramesRequest(), *ALL[2:]], MalformedError),
    "a header later": ([*ALL[:4], ALL[0], *ALL[4:]], MalformedError),
    "no reference": ([ALL[0], *ALL[2:]], MalformedError),
    "frames before symbols": ([*ALL[:2], FRAMES[0], SYMBOLS[0], *ALL[4:]], MalformedError),
    "symbols twice": ([*ALL[:3], *ALL[2:]], MalformedError),
    "reference again": ([*ALL[:4], REFERENCE, *ALL[4:]], MalformedError),
    "a page less": (ALL[:4], MalformedError),
    "no page": (ALL[:2], MalformedError),
    "a page more": ([*ALL, SYMBOLS[0], FRAMES[0]], MalformedError),
    "symbols without frames": (ALL[:5], FrameError),
    "half a reference": ([ALL[0], reference(REFERENCE.reference[:-1]), *ALL[2:]], FrameError),
    "half a page in the middle": ([*ALL[:3], chunk(FRAMES[0].chunk[:-1]), *ALL[4:]], FrameError),
    "half a page at the end": ([*ALL[:-1], chunk(FRAMES[1].chunk[:-1])], FrameError),
    "a byte more": ([*ALL, chunk(b"x")], FrameError),
    "a byte more in a chunk": ([*ALL[:3], chunk(FRAMES[0].chunk + b"x"), *ALL[4:]], FrameError),
    "a reference too long": ([*ALL[:2], reference(b"x"), *ALL[2:]], FrameError),
    "other columns": ([header(columns_px=95)], FrameError),
    "other rows": ([header(rows_px=0)], FrameError),
    "other type": ([header(pixel_type=pb.PIXEL_TYPE_UINT16)], FrameError),
    "other depth": ([header(bit_depth=10)], FrameError),
    "no type": ([header(pixel_type=0)], InvalidInputError),
    "black beyond": ([header(black_level=256)], InvalidInputError),
    "no levels": ([header(levels=0)], PageError),
    "one level": ([header(levels=1)], PageError),
    "too many levels": ([header(levels=257)], PageError),
    "one page": ([header(pages=1)], InvalidInputError),
    "no pages": ([header(pages=0)], InvalidInputError),
    "too many pages": ([header(pages=17)], LimitError),
    "huge frames": ([header(rows_px=1 << 20, columns_px=1 << 20)], LimitError),
    "few flags": ([header(pilot_mask=flags()[:-1])], PageError),
    "a flag of 2": ([header(pilot_mask=flags(2))], PageError),
    "no pilots": ([header(pilot_mask=bytes(16 * 24))], PageError),
    "only pilots": ([header(pilot_mask=b"\1" * (16 * 24))], PageError),
    "few symbols": ([*ALL[:2], symbols(SYMBOLS[0].symbols[:-1]), *ALL[3:]], PageError),
    "no symbols": ([*ALL[:2], symbols(b""), *ALL[3:]], PageError),
    "a symbol beyond the levels": ([header(levels=15), *ALL[1:]], PageError),
    "too large a chunk": ([ALL[0], reference(bytes((1 << 20) + 1))], LimitError),
}


def sent_raw(service: Service, parts: Parts) -> pb.Job:
    try:
        return service.stub().RecalibrateFrames(iter(parts), timeout=20)  # type: ignore[no-any-return]
    except grpc.RpcError as error:
        raise error_of(error, service.server.target) from None


def test_the_right_order_is_taken_in_chunks_of_any_size(start: Start) -> None:
    service = start()

    def halves(part: pb.RecalibrateFramesRequest) -> Parts:
        kind = part.WhichOneof("part")
        if kind not in ("reference", "chunk"):
            return [part]
        data = getattr(part, kind)
        return [pb.RecalibrateFramesRequest(**{kind: piece}) for piece in (data[:1], b"", data[1:9000], data[9000:])]

    job = sent_raw(service, [piece for part in ALL for piece in halves(part)])
    assert job.state == pb.JOB_STATE_RUNNING
    assert [one.state for one in service.client.watch_job(job.id, 20)][-1] is JobState.DONE


@pytest.fixture(scope="module")
def shared(toy_zip: Path) -> Iterator[Service]:
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)))
    recalibrator = Recalibrator(plane, toy.fit_references)
    with LightpageServer(plane, recalibrator) as server, LightpageClient(server.target) as client:
        yield Service(plane, recalibrator, server, toy.ToySource(toy.ToyDevice()), client)


@pytest.mark.parametrize("what", WRONG)
def test_bad_input_is_named_and_leaves_nothing(what: str, shared: Service) -> None:
    parts, kind = WRONG[what]
    with pytest.raises(kind) as caught:
        sent_raw(shared, parts)
    assert type(caught.value) is kind
    assert shared.client.jobs() == []
    assert shared.plane.received.used == 0


def test_what_comes_counts_against_the_memory_until_the_job_has_ended(start: Start) -> None:
    fit = slow_fit()
    limits = Limits(receive_bytes=4 * PAIR_BYTES)
    service = start(fit, limits=limits)
    job = send(service.client, PAGES)
    assert fit.entered.wait(10)
    held = 3 * PAIR_BYTES + 2 * 16 * 24
    assert service.plane.received.used == held
    fit.go.set()
    service.last(job)
    assert service.plane.received.used == 0
    service.plane.received.take(2 * PAIR_BYTES)
    with pytest.raises(OverloadedError):
        send(service.client, PAGES)
    assert service.plane.received.used == 2 * PAIR_BYTES
    service.plane.received.give_back(2 * PAIR_BYTES)
    with pytest.raises(LimitError, match="frames to recalibrate with"):  # waiting would not help
        send(service.client, known(4))


def test_a_caller_who_leaves_or_stalls_leaves_nothing(start: Start) -> None:
    service = start(limits=Limits(stall_s=0.3))
    leave, used = threading.Event(), service.plane.received

    def half() -> Iterator[pb.RecalibrateFramesRequest]:
        yield from ALL[:4]
        leave.wait(20)

    service.plane.limits.__dict__["stall_s"] = 20.0  # frozen against mistakes, and this is none
    call = service.stub().RecalibrateFrames.future(half(), timeout=20)
    assert wait_until(lambda: used.used == 2 * PAIR_BYTES + 16 * 24)
    call.cancel()
    leave.set()
    assert wait_until(lambda: used.used == 0)
    service.plane.limits.__dict__["stall_s"] = 0.3
    leave.clear()
    with pytest.raises(grpc.RpcError) as caught:
        service.stub().RecalibrateFrames(half(), timeout=20)
    assert isinstance(error_of(caught.value, "x"), StalledError)
    leave.set()
    assert used.used == 0
    assert service.client.jobs() == []


@pytest.mark.parametrize("way", ["cancels", "hangs up", "runs out of time"])
def test_a_caller_who_has_sent_all_and_leaves_starts_nothing(way: str, start: Start) -> None:
    """Only a stream that its caller has closed counts: the library ends that of one who has gone too."""
    service, open_end = start(), threading.Event()

    def all_but_the_end() -> Iterator[pb.RecalibrateFramesRequest]:
        yield from ALL
        open_end.wait(20)

    used = service.plane.received
    with grpc.insecure_channel(service.server.target, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        stub = pb_grpc.LightpageStub(channel)
        call = stub.RecalibrateFrames.future(all_but_the_end(), timeout=1.0 if way == "runs out of time" else 20)
        assert wait_until(lambda: used.used == 3 * PAIR_BYTES + 2 * 16 * 24)
        if way == "cancels":
            call.cancel()
        elif way == "hangs up":
            channel.close()
        assert wait_until(lambda: used.used == 0)
    open_end.set()
    assert service.client.jobs() == []


def test_the_client_refuses_what_it_cannot_send(start: Start) -> None:
    client, pages = start().client, known(2)
    wide = FramePair(*2 * (np.zeros((64, 97), np.uint8),))
    for bad, kind in (
        (KnownPages(pages.pairs, pages.symbols[:1], 16, pages.references), InvalidInputError),
        (KnownPages((pages.pairs[0], wide), pages.symbols, 16, pages.references), FrameError),
        (
            KnownPages(pages.pairs, (pages.symbols[0], pages.symbols[1] + np.uint16(300)), 16, pages.references),
            PageError,
        ),
        (KnownPages(pages.pairs, (pages.symbols[0], pages.symbols[1] * 1.0), 16, pages.references), PageError),  # type: ignore[arg-type]
    ):
        with pytest.raises(kind):
            send(client, bad)


def test_progress_rises_with_every_page_that_is_read_and_ends_with_the_job(start: Start) -> None:
    service = start()
    told = list[tuple[str, float]]()
    service.client.recalibrate(count=6, progress=lambda *step: told.append(step))
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    read = [share for name, share in told if name == "read the pages"]
    assert len(set(read)) >= 6
    assert read[0] == 0
    assert 0.1 < read[-1] < 0.3  # a page is read in about the time of a decode; twelve of these and the fit follow
    assert shares[-1] == 1
