"""Recalibrations as jobs over the wire: they survive their callers, and frames that are sent serve as a recording."""

import asyncio
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import grpc
import numpy as np
import pytest

from lightpage.errors import (
    BlackFrameError,
    FrameError,
    InvalidInputError,
    JobCancelledError,
    LightpageError,
    LimitError,
    MalformedError,
    NoSuchJobError,
    OtherModelError,
    OverloadedError,
    PageError,
    RecalibrationRefusedError,
)
from lightpage.page.symbols import pilot_mask
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.client.answers import JobInfo, JobState
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.recalibration.known_pages import KnownPages, read_recorded
from lightpage.runtime.service.jobs.job_calls import JobCalls
from lightpage.runtime.service.limits import Limits
from tests.runtime import toy
from tests.runtime.recalibration.toy_worker import DRIFTED, known
from tests.runtime.service.stage import Running, Start, raised, refused, until_told
from tests.runtime.slow_fit import SlowFit
from tests.waiting import eventually

Part = pb.RecalibrateFramesRequest
Parts = Sequence[Part]


def send(client: LightpageClient, pages: KnownPages, **options: object) -> JobInfo:
    assert pages.references is not None
    given = {"levels": pages.levels, "pilot_mask": pages.pilot_mask, **options}
    return client.jobs.start_with_frames(pages.pairs, pages.symbols, pages.references, **given)  # type: ignore[arg-type]


def header(**changes: object) -> Part:
    usual = {"rows_px": 64, "columns_px": 96, "pixel_type": pb.PIXEL_TYPE_UINT8, "bit_depth": 8}
    given = {**usual, "levels": 16, "pages": 2, **changes}
    return Part(header=pb.RecalibrateFramesHeader(**given))  # type: ignore[arg-type]


PAGES = known(count=2)
assert PAGES.references is not None
REFERENCE = Part(reference=PAGES.references.in_phase.tobytes() + PAGES.references.quadrature.tobytes())
SYMBOLS = [Part(symbols=page.tobytes()) for page in PAGES.symbols]
FRAMES = [Part(chunk=pair.in_phase.tobytes() + pair.quadrature.tobytes()) for pair in PAGES.pairs]
ALL = [header(), REFERENCE, SYMBOLS[0], FRAMES[0], SYMBOLS[1], FRAMES[1]]
PAIR_BYTES = 2 * 64 * 96
ALL_BYTES = 3 * PAIR_BYTES + 2 * 16 * 24


# ---- jobs ---------------------------------------------------------------------------------------------------------


def test_a_job_survives_its_caller_and_is_kept_over_a_restart(start: Start, tmp_path: Path) -> None:
    fit = SlowFit()
    service = start(fit=fit, store=tmp_path / "store")
    with LightpageClient(service.server.target) as caller:
        job = caller.jobs.start(count=2, correlation_id="night shift")
    assert fit.entered.wait(60)
    assert (job.state, job.pages_of, job.correlation_id) == (JobState.RUNNING, "source", "night shift")
    fit.go.set()
    done = service.last(job)
    assert (done.id, done.state, done.error, done.correlation_id) == (job.id, JobState.DONE, None, "night shift")
    assert done.result is not None
    assert (done.result.model_version, done.result.pages_used) == ("toy-1+r1", 2)
    assert done.ended_s is not None
    assert done.ended_s >= job.created_s > 1.7e9  # seconds of the epoch
    assert service.version == "toy-1+r1"
    service.end()
    again = start(store=tmp_path / "store")
    assert again.client.jobs.list() == list(again.client.jobs.watch(done.id, 20)) == [done]
    assert again.version == "toy-1+r1"


def test_a_watch_tells_each_change_and_holds_no_thread(start: Start) -> None:
    fit = SlowFit()
    service = start(fit=fit, limits=Limits(concurrent_calls=2))
    job = service.client.jobs.start(count=2)
    assert fit.entered.wait(60)
    told: list[list[JobInfo]] = [[] for _ in range(4)]
    with ThreadPoolExecutor(len(told)) as pool:
        for one in told:
            pool.submit(lambda one=one: one.extend(service.client.jobs.watch(job.id, 60)))  # type: ignore[misc]
        eventually(lambda: all(told))
        assert service.client.jobs.get(job.id).state is JobState.RUNNING  # there is room for calls beside them
        fit.go.set()
    for one in told:
        assert {job.state for job in one[:-1]} == {JobState.RUNNING}
        assert one[-1].state is JobState.DONE
        assert [job.fraction for job in one] == sorted(job.fraction for job in one)
    eventually(lambda: service.count("lightpage_calls_in_flight") == 0)


def test_a_cancelled_job_changes_nothing_and_makes_room(start: Start) -> None:
    fit = SlowFit()
    service = start(fit=fit)
    job = service.client.jobs.start(count=2)
    assert fit.entered.wait(60)
    cancelled = service.client.jobs.cancel(job.id)
    assert cancelled.state is JobState.CANCELLED
    assert isinstance(cancelled.error, JobCancelledError)
    assert service.version == "toy-1"
    assert service.client.jobs.cancel(job.id).ended_s == cancelled.ended_s
    fit.go.set()
    done = service.last(service.client.jobs.start(count=2))
    assert done.state is JobState.DONE
    assert service.client.jobs.cancel(done.id) == done
    calls = service.client.jobs
    for call in (calls.get, calls.cancel, lambda name: list(calls.watch(name, 20))):
        with pytest.raises(NoSuchJobError):
            call("no-such-job")
    assert service.version == "toy-1+r1"


def test_a_job_that_does_not_hear_of_its_end_is_told_as_it_runs() -> None:
    cancelled, running = list[str](), pb.Job(id="deaf", state=pb.JOB_STATE_RUNNING)
    jobs = SimpleNamespace(cancel=cancelled.append, job=lambda _: running)
    times = iter((0.0, 1.9, 2.1))
    calls = JobCalls(None, SimpleNamespace(jobs=jobs), lambda: next(times))  # type: ignore[arg-type]
    assert asyncio.run(calls.CancelJob(pb.CancelJobRequest(id="deaf"), None)) is running  # type: ignore[arg-type]
    assert cancelled == ["deaf"]
    assert next(times, None) is None


def test_a_job_that_ends_badly_says_why_as_a_call_would(start: Start, tmp_path: Path) -> None:
    service = start()
    toy.write_toy_recording(tmp_path / "short.h5", toy.ToyDevice(), 16, 2)
    end = service.last(service.client.jobs.start(recording="short.h5", count=3))
    assert (end.state, end.pages_of) == (JobState.FAILED, "recording short.h5")
    assert isinstance(end.error, InvalidInputError)
    pages = known(count=3)
    wrong = KnownPages(pages.pairs, tuple(15 - page for page in pages.symbols), 16, pages.references)
    end = service.last(send(service.client, wrong))
    assert (end.state, type(end.error)) == (JobState.REFUSED, RecalibrationRefusedError)
    message = service.stub.GetJob(pb.GetJobRequest(id=end.id), timeout=20)
    assert message.refusal.code == grpc.StatusCode.FAILED_PRECONDITION.value[0]
    assert message.refusal.reason == pb.ERROR_REASON_RECALIBRATION_REFUSED
    # what is known at once fails the call
    for options, kind in (({"count": 17}, LimitError), ({"recording": "absent.h5"}, InvalidInputError)):
        with pytest.raises(kind):
            service.client.jobs.start(**options)
    answer = refused(lambda: service.stub.StartRecalibration(pb.StartRecalibrationRequest(), timeout=20))
    assert (answer.code, answer.subject) == (grpc.StatusCode.INVALID_ARGUMENT, "pages")
    assert len(service.client.jobs.list()) == 2


def test_the_model_in_service_must_be_the_one_expected(start: Start) -> None:
    service = start()
    calls: list[Callable[[str], object]] = [
        lambda version: service.client.jobs.start(count=2, expected_version=version),
        lambda version: service.client.jobs.recalibrate(count=2, expected_version=version),
        lambda version: send(service.client, PAGES, expected_version=version),
    ]
    for call in calls:
        with pytest.raises(OtherModelError) as caught:
            call("toy-0")
        assert caught.value.got == "toy-1"
    assert service.client.jobs.list() == []
    assert service.last(send(service.client, PAGES, expected_version="toy-1")).state is JobState.DONE


# ---- frames that are sent -----------------------------------------------------------------------------------------


def test_frames_that_are_sent_give_what_the_same_pages_of_a_recording_give(start: Start, tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "known.h5", toy.ToyDevice(DRIFTED), 16, 4)
    one, other = start(), start(source=None)
    recorded = one.last(one.client.jobs.start(recording="known.h5"))
    with Recording.open(tmp_path / "known.h5") as recording:
        pages = read_recorded(recording, range(4))
    sent = other.last(send(other.client, pages, pilot_mask=pilot_mask(toy.PROFILE), correlation_id="sent"))
    assert (sent.pages_of, sent.correlation_id, recorded.pages_of) == ("frames", "sent", "recording known.h5")
    assert sent.result is not None
    assert recorded.result is not None
    for name in ("model_version", "previous_version", "pages_used", "pages_held_back", "air_before", "air_after"):
        assert getattr(sent.result, name) == getattr(recorded.result, name)
    assert sent.result.air_after > sent.result.air_before + 0.5
    bundles = [service.plane.models.current.decoder.bundle for service in (one, other)]
    assert bundles[0].files == bundles[1].files
    assert other.plane.received.used == 0


def test_the_black_level_is_taken_off_all_frames(start: Start) -> None:
    fit = Mock(wraps=toy.fit_references)
    service, pages = start(source=None, fit=fit), known((125.0, 82.0), 2)
    assert pages.references is not None
    brighter = KnownPages(
        tuple(raised(pair, 20) for pair in pages.pairs), pages.symbols, 16, raised(pages.references, 20)
    )
    assert service.last(send(service.client, brighter, black_level=20)).state is JobState.DONE
    seen = fit.call_args.args[1]
    assert (seen.references.in_phase == 125).all()
    assert (seen.pairs[0].quadrature == np.minimum(pages.pairs[0].quadrature, 235)).all()


def test_dark_frames_are_left_out_and_too_many_are_the_callers_fault(start: Start) -> None:
    service, pages = start(), known(count=4)
    dark = FramePair(*2 * (np.zeros(toy.SHAPE, np.uint8),))
    one_dark = KnownPages((pages.pairs[0], dark, *pages.pairs[2:]), pages.symbols, 16, pages.references)
    done = service.last(send(service.client, one_dark)).result
    assert done is not None
    assert done.pages_used == 3
    twice_dark = KnownPages((pages.pairs[0], dark, dark), pages.symbols[:3], 16, pages.references)
    for bad, named in ((twice_dark, "page 2"), (KnownPages(pages.pairs, pages.symbols, 16, dark), "reference")):
        with pytest.raises(BlackFrameError) as error:
            send(service.client, bad)
        assert named in error.value.subject
    assert len(service.client.jobs.list()) == 1
    assert service.plane.received.used == 0


FLAGS = pilot_mask(toy.PROFILE).astype(np.uint8).tobytes()
WRONG: dict[str, tuple[Parts, type[LightpageError]]] = {
    "nothing": ([], MalformedError),
    "no header": (ALL[1:], MalformedError),
    "an empty message": ([*ALL[:2], Part(), *ALL[2:]], MalformedError),
    "a header later": ([*ALL[:4], ALL[0], *ALL[4:]], MalformedError),
    "no reference": ([ALL[0], *ALL[2:]], MalformedError),
    "frames before symbols": ([*ALL[:2], FRAMES[0], SYMBOLS[0], *ALL[4:]], MalformedError),
    "reference again": ([*ALL[:4], REFERENCE, *ALL[4:]], MalformedError),
    "a page less": (ALL[:4], MalformedError),
    "a page more": ([*ALL, SYMBOLS[0], FRAMES[0]], MalformedError),
    "half a reference": ([ALL[0], Part(reference=REFERENCE.reference[:-1]), *ALL[2:]], FrameError),
    "half a page in the middle": ([*ALL[:3], Part(chunk=FRAMES[0].chunk[:-1]), *ALL[4:]], FrameError),
    "a byte more": ([*ALL, Part(chunk=b"x")], FrameError),
    "other columns": ([header(columns_px=95)], FrameError),
    "other depth": ([header(bit_depth=10)], FrameError),
    "no type": ([header(pixel_type=0)], InvalidInputError),
    "black beyond": ([header(black_level=256)], InvalidInputError),
    "one level": ([header(levels=1)], PageError),
    "one page": ([header(pages=1)], InvalidInputError),
    "too many pages": ([header(pages=17)], LimitError),
    "as many as may be, but fewer come": ([header(pages=16), *ALL[1:]], MalformedError),
    "few flags": ([header(pilot_mask=FLAGS[:-1])], PageError),
    "a flag of 2": ([header(pilot_mask=b"\2" + FLAGS[1:])], PageError),
    "no pilots": ([header(pilot_mask=bytes(16 * 24))], PageError),
    "only pilots": ([header(pilot_mask=b"\1" * (16 * 24))], PageError),
    "few symbols": ([*ALL[:2], Part(symbols=SYMBOLS[0].symbols[:-1]), *ALL[3:]], PageError),
    "a symbol beyond the levels": ([header(levels=15), *ALL[1:]], PageError),
    "too large a chunk": ([ALL[0], Part(reference=bytes((1 << 20) + 1))], LimitError),
}


def halves(part: Part) -> Parts:
    kind = part.WhichOneof("part")
    if kind not in ("reference", "chunk"):
        return [part]
    data = getattr(part, kind)
    return [Part(**{kind: piece}) for piece in (data[:1], b"", data[1:9000], data[9000:])]


def test_bad_input_is_named_and_leaves_nothing_and_good_input_comes_in_any_chunks(start: Start) -> None:
    service = start()
    for what, (messages, kind) in WRONG.items():
        answer = refused(lambda parts=messages: service.stub.RecalibrateFrames(iter(parts), timeout=20))  # type: ignore[misc]
        assert type(answer.error) is kind, what
        assert service.client.jobs.list() == [], what
        assert service.plane.received.used == 0, what
    job = service.stub.RecalibrateFrames(iter([piece for part in ALL for piece in halves(part)]), timeout=20)
    assert job.state == pb.JOB_STATE_RUNNING
    assert [one.state for one in service.client.jobs.watch(job.id, 20)][-1] is JobState.DONE


def test_what_comes_counts_against_the_memory_until_the_job_has_ended(start: Start) -> None:
    fit = SlowFit()
    service = start(fit=fit, limits=Limits(receive_bytes=4 * PAIR_BYTES, pair_bytes=PAIR_BYTES))
    job = send(service.client, PAGES)
    assert fit.entered.wait(60)
    assert service.plane.received.used == ALL_BYTES
    fit.go.set()
    service.last(job)
    assert service.plane.received.used == 0
    service.plane.received.take(2 * PAIR_BYTES)
    with pytest.raises(OverloadedError):
        send(service.client, PAGES)
    assert service.plane.received.used == 2 * PAIR_BYTES
    service.plane.received.give_back(2 * PAIR_BYTES)
    with pytest.raises(LimitError) as error:  # waiting would not help
        send(service.client, known(count=4))
    assert error.value.subject == "frames to recalibrate with"


@pytest.mark.parametrize("way", ["cancels", "hangs up", "runs out of time"])
def test_a_caller_who_has_not_closed_its_stream_and_leaves_starts_nothing(way: str, start: Start) -> None:
    """Only a stream that its caller has closed counts: the library ends that of one who has gone too."""
    service, more = start(), threading.Event()
    used, channel = service.plane.received, service.channel()
    call = service.stub.RecalibrateFrames.future(
        until_told(ALL, more), timeout=0.5 if way == "runs out of time" else 60
    )
    if way != "runs out of time":
        eventually(lambda: used.used == ALL_BYTES)
        leave = call.cancel if way == "cancels" else channel.close
        leave()
    eventually(lambda: call.done() and used.used == 0)
    eventually(lambda: service.count("lightpage_calls_in_flight") == 0)
    more.set()
    assert service.client.jobs.list() == []


def test_the_client_refuses_what_it_cannot_send(service: Running) -> None:
    wide = FramePair(*2 * (np.zeros((64, 97), np.uint8),))
    for pairs, symbols_, kind in (
        (PAGES.pairs, PAGES.symbols[:1], InvalidInputError),
        ((PAGES.pairs[0], wide), PAGES.symbols, FrameError),
        (PAGES.pairs, (PAGES.symbols[0], PAGES.symbols[1] + np.uint16(300)), PageError),
    ):
        with pytest.raises(kind):
            send(service.client, KnownPages(pairs, symbols_, 16, PAGES.references))
