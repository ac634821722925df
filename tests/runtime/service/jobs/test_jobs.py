"""Jobs are told apart, kept over a restart whatever ended the service, and cost nobody more than their record."""

import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from lightpage.errors import (
    BusyError,
    CalibrationError,
    CallerLeft,
    FrameError,
    JobCancelledError,
    NoSuchJobError,
    RecalibrationRefusedError,
    StoppingError,
)
from lightpage.runtime.client.answers import job_info
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, Refit, RefitReport
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.jobs import Jobs
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.database import write_job
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import Store
from tests.clock import HandClock
from tests.lightpage.full_disk import full_disk
from tests.lightpage.small import EXPLAINED
from tests.runtime import toy
from tests.runtime.slow_fit import SlowFit

REPORT = RefitReport(angle_deg=0.5, goodness=EXPLAINED)
OUTCOME = RecalibrationOutcome(Path("x.zip"), "toy-1+r1", "toy-1", REPORT, 1.0, 3.5, 1, 3, 2, 4.0, 0.9, 0.1, rounds=3)


Open = Callable[..., Jobs]


@pytest.fixture
def stores(decoder: Decoder, tmp_path: Path) -> Callable[[], Store]:
    """Opens a store, the same one each time; the one before is closed."""
    opened: list[Store] = []

    def begin() -> Store:
        for store in opened:
            store.close()
        opened[:] = [Store(tmp_path, decoder.bundle)]
        return opened[0]

    return begin


@pytest.fixture
def start(stores: Callable[[], Store]) -> Open:
    """The jobs of a service as they are after a restart."""
    return lambda **options: Jobs(stores(), **options)


def ended(jobs: Jobs, end: RecalibrationOutcome | BaseException = OUTCOME) -> str:
    running = jobs.begin("source", Caller(), "mine")
    jobs.end(running, end)
    return running.id


def test_one_runs_at_a_time_and_the_second_hears_which(start: Open) -> None:
    clock = HandClock()
    jobs = start(clock=clock.now)
    running = jobs.begin("source", Caller())
    with pytest.raises(BusyError, match=running.id) as caught:
        jobs.begin("frames", Caller())
    assert caught.value.job == running.id
    with pytest.raises(BusyError):
        jobs.check_free()
    assert not jobs.wait_idle(0)
    jobs.cancel(running.id)
    assert not running.caller.is_here
    with pytest.raises(JobCancelledError):
        running.check()
    jobs.tell(running, "fit", 0.5)
    job = jobs.job(running.id)
    assert (job.state, job.progress.step, job.progress.fraction) == (pb.JOB_STATE_RUNNING, "fit", 0.5)
    clock.advance(5.0)
    jobs.end(running, OUTCOME)
    ended = jobs.job(running.id)
    assert (job.created_s, job.ended_s, ended.created_s, ended.ended_s) == (1000.0, 0.0, 1000.0, 1005.0)
    assert jobs.wait_idle(0)
    jobs.check_free()
    assert jobs.begin("frames", Caller()).id != running.id


def test_a_job_is_named_to_others_once_it_can_be_found(stores: Callable[[], Store]) -> None:
    store = stores()
    jobs, transaction = Jobs(store), store.transaction

    @contextmanager
    def slow() -> Iterator[sqlite3.Connection]:
        jobs.check_free()
        with transaction() as database:
            yield database

    store.transaction = slow  # type: ignore[method-assign,assignment]
    jobs.begin("source", Caller())


@pytest.mark.parametrize(
    ("end", "state"),
    [
        (OUTCOME, pb.JOB_STATE_DONE),
        (replace(OUTCOME, air_before=float("-inf")), pb.JOB_STATE_DONE),
        (RecalibrationRefusedError("fit", "worse", "better"), pb.JOB_STATE_REFUSED),
        (CalibrationError("fit", "nothing", "a peak"), pb.JOB_STATE_REFUSED),
        (FrameError("frame", "black", "light"), pb.JOB_STATE_FAILED),
        (ZeroDivisionError("a bug"), pb.JOB_STATE_FAILED),
        (JobCancelledError("job", "cancelled", "one that goes on"), pb.JOB_STATE_CANCELLED),
        (CallerLeft(), pb.JOB_STATE_CANCELLED),
        (StoppingError("job", "the end", "more"), pb.JOB_STATE_INTERRUPTED),
    ],
)
def test_each_end_is_told_and_kept_over_a_restart(
    end: RecalibrationOutcome | BaseException, state: pb.JobState, start: Open, decoder: Decoder
) -> None:
    jobs = start()
    found = jobs.job(ended(jobs, end))
    assert found.state == state
    assert found.HasField("result") == isinstance(end, RecalibrationOutcome) != found.HasField("refusal")
    if (result := job_info(found).result) is not None:
        assert (result.rounds, result.verdict, result.bits_lost, result.cause) == (3, "good", 0.01, None)
        assert {"3", "good"} <= {*result.told.split()}
    assert (found.correlation_id, found.pages_of) == ("mine", "source")
    assert start().all() == [found]
    assert Jobs(Store(None, decoder.bundle)).all() == []


def test_the_newest_come_first_and_the_oldest_are_forgotten(start: Open) -> None:
    jobs = start(kept=3)
    names = [ended(jobs) for _ in range(5)]
    assert [job.id for job in jobs.all()] == names[:1:-1]
    assert [job.id for job in start(kept=2).all()] == names[:2:-1]
    for unknown in (names[0], "", "x"):
        with pytest.raises(NoSuchJobError):
            jobs.job(unknown)
        with pytest.raises(NoSuchJobError):
            jobs.cancel(unknown)


@pytest.mark.parametrize("written", [True, False])
def test_a_job_that_a_kill_interrupted_is_done_where_its_model_is_written(
    written: bool, start: Open, stores: Callable[[], Store]
) -> None:
    store = stores()
    before = Jobs(store)
    first, running = ended(before), before.begin("frames", Caller())
    if written:
        store.save(store.contents.state, before.done(running, OUTCOME))
    assert not before.job(running.id).HasField("result")  # nobody hears of it before it is so
    after = start(clock=lambda: 7.0)
    job = after.job(running.id)
    assert job.state == (pb.JOB_STATE_DONE if written else pb.JOB_STATE_INTERRUPTED)
    assert job.HasField("result") == written == (job.ended_s != 7.0)
    assert job.refusal.detail.kind == ("" if written else "StoppingError")
    assert after.job(first).state == pb.JOB_STATE_DONE
    assert after.wait_idle(0)
    assert [one.state for one in start().all()] == [job.state, pb.JOB_STATE_DONE]


def test_a_damaged_record_is_forgotten_with_a_warning(
    start: Open, stores: Callable[[], Store], caplog: pytest.LogCaptureFixture
) -> None:
    with stores().transaction() as database:
        write_job(database, "x", b"\xff", 9)
    jobs = start()
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert jobs.all() == []


def test_a_full_disk_costs_the_record_and_not_the_job(start: Open) -> None:
    jobs = start()
    kept = ended(jobs)
    with full_disk(10):
        lost = ended(jobs)
    assert jobs.job(lost).state == pb.JOB_STATE_DONE
    assert [job.id for job in start().all()] == [kept]


def test_what_nobody_foresaw_is_logged_with_its_traceback(start: Open, caplog: pytest.LogCaptureFixture) -> None:
    jobs, caught = start(), ZeroDivisionError("a bug")
    with caplog.at_level(logging.INFO):
        ended(jobs, FrameError("frame", "black", "light"))
        ended(jobs, caught)
    assert [(each.levelname, bool(each.exc_info)) for each in caplog.records] == [("INFO", False), ("ERROR", True)]
    assert "a bug" not in jobs.all()[0].refusal.detail.got  # its text may hold anything


Make = Callable[..., Recalibrator]


@pytest.fixture
def make(decoder: Decoder, stores: Callable[[], Store]) -> Make:
    def begin(fit: Refit = toy.fit_references) -> Recalibrator:
        return Recalibrator(DataPlane(Models(decoder, stores()), toy.ToySource(toy.ToyDevice())), fit)

    return begin


def test_the_end_of_the_service_interrupts_the_job_and_the_next_start_knows(make: Make) -> None:
    fit = SlowFit()
    recalibrator = make(fit)
    job = recalibrator.start(recalibrator.source_pages(2), correlation_id="night")
    assert fit.entered.wait(60)
    recalibrator.close(60.0)
    with pytest.raises(StoppingError):
        recalibrator.start(recalibrator.source_pages(2))
    found = make().jobs.job(job.id)
    assert (found.state, found.correlation_id) == (pb.JOB_STATE_INTERRUPTED, "night")
    assert found.refusal.detail.kind == "StoppingError"


def test_a_thread_that_cannot_be_started_leaves_nothing_that_runs(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    recalibrator = make()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", Mock(side_effect=RuntimeError("can't start new thread")))
        with pytest.raises(RuntimeError):
            recalibrator.start(recalibrator.source_pages(2))
    assert recalibrator.jobs.all()[0].state == pb.JOB_STATE_FAILED
    recalibrator.start(recalibrator.source_pages(2))
    assert recalibrator.jobs.wait_idle(60)
    assert recalibrator.jobs.all()[0].state == pb.JOB_STATE_DONE
