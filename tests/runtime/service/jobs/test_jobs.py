"""Jobs are told apart, kept over a restart whatever ended the service, and cost nobody more than their record."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

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
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome, Refit, RefitReport
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.jobs import DAMAGED, FILE, Jobs
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.registry import ModelRegistry
from lightpage.runtime.service.models.store import ModelStore
from tests.clock import HandClock
from tests.lightpage.full_disk import full_disk
from tests.runtime import toy
from tests.runtime.slow_fit import SlowFit

OUTCOME = RecalibrationOutcome(
    Path("x.zip"), "toy-1+r1", "toy-1", RefitReport(angle_deg=0.5), 1.0, 3.5, 1, 3, 2, 4.0, 0.9, 0.1
)


def ended(jobs: Jobs, end: RecalibrationOutcome | BaseException = OUTCOME) -> str:
    running = jobs.begin("source", Caller(), "mine")
    jobs.end(running, end)
    return running.id


def test_one_runs_at_a_time_and_the_second_hears_which() -> None:
    clock = HandClock()
    jobs = Jobs(clock=clock.now)
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
    jobs.tell("fit", 0.5)
    job = jobs.job(running.id)
    assert (job.state, job.progress.step, job.progress.fraction) == (pb.JOB_STATE_RUNNING, "fit", 0.5)
    clock.advance(5.0)
    jobs.end(running, OUTCOME)
    ended = jobs.job(running.id)
    assert (job.created_s, job.ended_s, ended.created_s, ended.ended_s) == (1000.0, 0.0, 1000.0, 1005.0)
    assert jobs.wait_idle(0)
    jobs.check_free()
    assert jobs.begin("frames", Caller()).id != running.id


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
    end: RecalibrationOutcome | BaseException, state: pb.JobState, tmp_path: Path
) -> None:
    jobs = Jobs(tmp_path)
    found = jobs.job(ended(jobs, end))
    assert found.state == state
    assert found.HasField("result") == isinstance(end, RecalibrationOutcome) != found.HasField("refusal")
    assert (found.correlation_id, found.pages_of) == ("mine", "source")
    assert Jobs(tmp_path).all() == [found]
    assert Jobs(None).all() == []


def test_the_newest_come_first_and_the_oldest_are_forgotten(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path, kept=3)
    names = [ended(jobs) for _ in range(5)]
    assert [job.id for job in jobs.all()] == names[:1:-1]
    assert [job.id for job in Jobs(tmp_path, kept=2).all()] == names[:2:-1]
    for unknown in (names[0], "", "x"):
        with pytest.raises(NoSuchJobError):
            jobs.job(unknown)
        with pytest.raises(NoSuchJobError):
            jobs.cancel(unknown)


@pytest.mark.parametrize(
    ("in_service", "foretold", "state"),
    [("toy-1+r1", True, "DONE"), ("toy-1", True, "INTERRUPTED"), ("", False, "INTERRUPTED")],
)
def test_what_a_kill_interrupted_is_told_by_the_model_in_service(
    in_service: str, foretold: bool, state: str, tmp_path: Path
) -> None:
    before = Jobs(tmp_path)
    first = ended(before)
    running = before.begin("frames", Caller())
    if foretold:
        before.foretell(OUTCOME)
    assert not before.job(running.id).HasField("result")  # nobody hears of it before it is so
    after = Jobs(tmp_path, version=in_service, clock=lambda: 7.0)
    job = after.job(running.id)
    assert (job.state, job.ended_s) == (pb.JobState.Value(f"JOB_STATE_{state}"), 7.0)
    assert job.HasField("result") == (state == "DONE")
    assert job.refusal.detail.kind == ("" if state == "DONE" else "StoppingError")
    assert after.job(first).state == pb.JOB_STATE_DONE
    assert after.wait_idle(0)
    assert [one.state for one in Jobs(tmp_path).all()] == [job.state, pb.JOB_STATE_DONE]


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xfe",
        b'{"format": "lightpage-jobs", "version": 2, "jobs": []}',
        b'{"format": "lightpage-jobs", "version": 1, "jobs": [{"state": "JOB_STATE_DONE"}]}',
        b'{"format": "lightpage-jobs", "version": 1, "jobs": [{"id": "x", "ended_s": "soon"}]}',
        b"[" * 100_000,
    ],
)
def test_a_damaged_record_is_set_aside_with_a_warning(
    content: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / FILE).write_bytes(content)
    jobs = Jobs(tmp_path)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert jobs.all() == []
    assert (tmp_path / DAMAGED).read_bytes() == content
    done = ended(jobs)
    assert Jobs(tmp_path).job(done).state == pb.JOB_STATE_DONE


def test_what_a_newer_program_has_added_is_passed_over(tmp_path: Path) -> None:
    ended(Jobs(tmp_path))
    text = (tmp_path / FILE).read_text()
    (tmp_path / FILE).write_text(text.replace('"id"', '"colour": "green", "id"'))
    assert Jobs(tmp_path).all()[0].state == pb.JOB_STATE_DONE
    assert not (tmp_path / DAMAGED).exists()


def test_a_full_disk_costs_the_record_and_not_the_job(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path)
    kept = ended(jobs)
    with full_disk(10):
        lost = ended(jobs)
    assert jobs.job(lost).state == pb.JOB_STATE_DONE
    assert [job.id for job in Jobs(tmp_path).all()] == [kept]
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


def test_what_nobody_foresaw_is_logged_with_its_traceback(caplog: pytest.LogCaptureFixture) -> None:
    jobs, caught = Jobs(), ZeroDivisionError("a bug")
    with caplog.at_level(logging.INFO):
        ended(jobs, FrameError("frame", "black", "light"))
        ended(jobs, caught)
    assert [(each.levelname, bool(each.exc_info)) for each in caplog.records] == [("INFO", False), ("ERROR", True)]
    assert "a bug" not in jobs.all()[0].refusal.detail.got  # its text may hold anything


Make = Callable[..., Recalibrator]


@pytest.fixture
def make(decoder: Decoder) -> Make:
    def begin(fit: Refit = toy.fit_references, store: Path | None = None) -> Recalibrator:
        models = None if store is None else ModelStore(store, decoder.bundle)
        return Recalibrator(DataPlane(ModelRegistry(decoder), toy.ToySource(toy.ToyDevice()), models), fit)

    return begin


def test_the_end_of_the_service_interrupts_the_job_and_the_next_start_knows(make: Make, tmp_path: Path) -> None:
    fit = SlowFit()
    recalibrator = make(fit, tmp_path)
    job = recalibrator.start(recalibrator.source_pages(2), correlation_id="night")
    assert fit.entered.wait(60)
    recalibrator.close(60.0)
    with pytest.raises(StoppingError):
        recalibrator.start(recalibrator.source_pages(2))
    found = make(store=tmp_path).jobs.job(job.id)
    assert (found.state, found.correlation_id) == (pb.JOB_STATE_INTERRUPTED, "night")
    assert found.refusal.detail.kind == "StoppingError"


def test_a_thread_that_cannot_be_started_leaves_nothing_that_runs(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    recalibrator = make()

    def none(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", none)
        with pytest.raises(RuntimeError):
            recalibrator.start(recalibrator.source_pages(2))
    assert recalibrator.jobs.all()[0].state == pb.JOB_STATE_FAILED
    recalibrator.start(recalibrator.source_pages(2))
    assert recalibrator.jobs.wait_idle(60)
    assert recalibrator.jobs.all()[0].state == pb.JOB_STATE_DONE
