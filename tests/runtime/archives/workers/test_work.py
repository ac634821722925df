"""What a worker makes of a range: a finding about each page, or none at all, which another try may change."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

from lightpage.errors import LostPageError, RecalibrationRefusedError, StorageError
from lightpage.recording.pages import Pages
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings import page_reader
from lightpage.runtime.archives.recordings.page_reader import Healings, PageReader
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.question import of_recordings
from lightpage.runtime.archives.run.shard import PageState, ShardRecord, record_of
from lightpage.runtime.archives.run.task import Choices, Done, Failed, FineTuning, Operation, RecordedFile, Stamp, Task
from lightpage.runtime.archives.workers import device
from lightpage.runtime.archives.workers.device import EVERY_S, StepLog
from lightpage.runtime.archives.workers.work import Worker
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker
from tests.clock import HandClock
from tests.runtime import coded, toy

OPERATIONS = [Operation.DECODE, Operation.EVALUATE, Operation.RECOVER]
PAGES = 3


@pytest.fixture
def asked(tmp_path: Path) -> Callable[..., Task]:
    """A range of three pages that an operation is to read."""
    bundle = coded.bundle(tmp_path / "coded.zip")
    path = coded.recording(tmp_path / "a.h5", coded.pages(bundle, tmp_path)[:PAGES])

    def task(operation: Operation = Operation.DECODE, **changes: object) -> Task:
        choices = Choices(operation=operation, tracking=False)
        (one,) = Ledger(tmp_path / str(operation)).missing(of_recordings(choices, [str(path)], str(bundle), None))
        return one.model_copy(update=changes)

    return task


def failure(task: Task) -> Failed:
    outcome = Worker(1).work(task)
    assert isinstance(outcome, Failed)
    assert not record_of(task.shard).exists()
    return outcome


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_range_is_read_and_its_record_says_what_it_was(operation: Operation, asked: Callable[..., Task]) -> None:
    task = asked(operation)
    done = Worker(1).work(task)
    assert isinstance(done, Done)
    record = ShardRecord.read(task.shard)
    assert [(page.page, page.state) for page in record.pages] == [(page, PageState.READ) for page in range(PAGES)]
    with h5py.File(task.recording) as file:
        frames = [file[name].id.get_storage_size() / file[name].shape[0] for name in ("in_phase", "quadrature")]
    assert done.read_bytes == record.read_bytes == pytest.approx(sum(frames) * PAGES, rel=0.01)
    assert (record.model.version, done.lost, done.left_out, done.seconds) == ("toy-1", {}, 0, record.seconds)
    assert record.pages[0].figures["air_bits_per_symbol"] == pytest.approx(5, abs=0.5)
    assert bool(record.confidence_bins) == (operation is Operation.EVALUATE)


def test_a_range_is_read_in_batches_and_steps_as_many_as_are_asked_for(
    asked: Callable[..., Task], monkeypatch: Any
) -> None:
    monkeypatch.setattr("lightpage.runtime.archives.workers.work.Decoder", opened := Mock(wraps=Decoder))
    choices = Choices(operation=Operation.DECODE, tracking=False, batches=4, steps=2)
    assert isinstance(Worker(1).work(asked(choices=choices)), Done)  # a network's bundle, too
    assert opened.call_args.kwargs["batching"].largest == 4
    assert opened.call_args.kwargs["steps"] == 2


@pytest.mark.parametrize("operation", OPERATIONS)
def test_what_storage_does_not_give_is_no_finding_unless_it_is_given_up(
    operation: Operation, asked: Callable[..., Task], monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.frames_fail(monkeypatch, StorageError("recording a", "Input/output error", "data"), 1)
    failed = failure(asked(operation))
    assert (failed.problem.passes, failed.whole_recording) == (True, False)
    done = Worker(1).work(task := asked(operation, give_up=True))
    assert isinstance(done, Done)
    assert done.lost == {"storage" if operation is Operation.RECOVER else "StorageError": 1}
    assert [page.state for page in ShardRecord.read(task.shard).pages] == ["read", "lost", "read"]


@pytest.mark.parametrize("error", [MemoryError(), OSError(errno.EIO, "")])
def test_a_short_resource_is_no_finding_even_if_pages_are_given_up(
    error: Exception, asked: Callable[..., Task], monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.frames_fail(monkeypatch, error, 1)
    assert failure(asked()).problem.passes
    assert failure(asked(give_up=True)).problem.passes


def test_what_nobody_foresaw_ends_the_worker(asked: Callable[..., Task], monkeypatch: pytest.MonkeyPatch) -> None:
    toy.frames_fail(monkeypatch, ZeroDivisionError(), 1)
    with pytest.raises(ZeroDivisionError):
        Worker(1).work(asked())


def test_results_that_storage_does_not_take_make_no_page_lost(
    asked: Callable[..., Task], monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse = Mock(side_effect=StorageError("shard", "Input/output error", "a file that can be written"))
    monkeypatch.setattr("lightpage.runtime.archives.workers.page_range.write_user_bytes", refuse)
    failed = failure(asked(Operation.RECOVER, give_up=True))
    assert (failed.problem.subject, failed.problem.passes) == ("shard", True)


def test_another_recording_or_bundle_than_the_run_began_with_is_not_read(
    asked: Callable[..., Task], tmp_path: Path
) -> None:
    task = asked()
    os.utime(tmp_path / "a.h5", (1, 1))
    changed = failure(task)
    assert (changed.problem.passes, changed.whole_recording) == (False, True)
    file = task.files[0].model_copy(update={"path": tmp_path / "gone.h5"})
    gone = task.model_copy(update={"files": (file,)})
    failed = failure(gone)
    assert (failed.problem.subject, failed.whole_recording) == (f"recording {tmp_path / 'gone.h5'}", True)
    given_up = Worker(1).work(gone.model_copy(update={"give_up": True}))
    assert isinstance(given_up, Done)
    assert given_up.lost == {"RecordingError": PAGES}
    toy.write_toy_bundle(tmp_path / "other.zip", version="toy-2")
    (tmp_path / "other.zip").replace(tmp_path / "coded.zip")
    other = failure(task.model_copy(update={"shard": task.shard.with_name("other")}))
    assert (other.problem.subject, other.whole_recording) == (f"bundle {tmp_path / 'coded.zip'}", True)


def test_pages_that_the_bundle_was_made_from_are_left_out(asked: Callable[..., Task], tmp_path: Path) -> None:
    with Recording.open(tmp_path / "a.h5") as recording:
        seen = [recording.page_hash(1)]
    (tmp_path / "coded.zip").unlink()
    toy.write_toy_bundle(tmp_path / "coded.zip", trained_pages=seen)
    done = Worker(1).work(task := asked(Operation.EVALUATE))
    assert isinstance(done, Done)
    assert done.left_out == 1
    assert [page.state for page in ShardRecord.read(task.shard).pages] == ["read", "left out", "read"]


def test_an_evaluation_needs_symbols(asked: Callable[..., Task], tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["symbols"]
    failed = failure(asked(Operation.EVALUATE))
    assert (failed.problem.got, failed.whole_recording) == ("no symbols", True)
    assert isinstance(Worker(1).work(asked(Operation.DECODE)), Done)


def test_a_deep_recalibration_is_given_the_pages_of_user_data_that_were_read(
    asked: Callable[..., Task], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Pages.open(tmp_path / "pages.h5") as written:
        sent, seen = np.stack(list(written))[:8], list[np.ndarray | None]()
    paths = [coded.recording(tmp_path / f"{n}.h5", sent[n::2], {n: coded.half_lost}, known=False) for n in range(2)]
    files = tuple(RecordedFile(path=path, stamp=Stamp.of(path)) for path in paths)
    deeply = Choices(operation=Operation.RECALIBRATE, fine_tuning=FineTuning())
    task = asked(choices=deeply, files=files, pages=tuple(range(5)), run=tmp_path)

    def recalibrate(_: object, recording: Recording, *more: object) -> NoReturn:
        seen.extend(map(recording.symbols, range(len(recording))))
        raise RecalibrationRefusedError("model", "worse", "better")

    for _ in range(2):
        assert isinstance(Worker(1, deep=lambda: Mock(recalibrate=recalibrate)).work(task), Done)
        monkeypatch.setattr(device, "write_read_pages", Mock(side_effect=ZeroDivisionError))  # it is not read again
    np.testing.assert_array_equal(seen, [*sent[[2, 4, 6, 1, 5]]] * 2)  # as many as are wanted


def test_ranges_that_nothing_heals_are_tried_ever_less_often(
    asked: Callable[..., Task], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker, tries = Worker(1), list[int]()
    monkeypatch.setattr(page_reader, "heal", refuse := Mock(side_effect=RecalibrationRefusedError("", "", "")))
    sent = toy.symbols_of(coded.CODE.levels, 1, PAGES)
    coded.recording(tmp_path / "a.h5", sent, dict.fromkeys(range(PAGES), coded.dark))
    for _ in range(9):
        worker.work(task := asked(Operation.RECOVER))
        record_of(task.shard).unlink()
        tries.append(refuse.call_count)
    assert tries == [1, 1, 1, 1, 2, 2, 2, 2, 2]  # for any of them, then for twelve, then for 24


def test_a_range_begins_with_the_model_that_an_earlier_one_healed_and_falls_back_to_its_own(
    asked: Callable[..., Task], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blind, healings = type("Blind", (NoTracker,), {"decode": Mock(side_effect=LostPageError("", "", ""))}), Healings()
    decoder = Decoder.load(asked().bundle.path, threads=1)
    monkeypatch.setattr(page_reader, "heal", heal := Mock(return_value=Mock(decoder=decoder, rounds=1, seconds=0.0)))

    def read(tracker: NoTracker) -> list[int | None]:
        with Recording.open(tmp_path / "a.h5") as recording:
            reader = PageReader(decoder, recording, tracker, coded.CODE, healings=healings)
            return [page.healed_rounds for page in reader.read(range(PAGES), lambda page, found: None) if not page.loss]

    assert [read(blind(decoder)) for _ in range(2)] == [[1] * PAGES, [None] * PAGES]
    healings.model = decoder, blind(decoder)
    assert read(NoTracker(decoder)) == [None] * PAGES
    assert (healings.model, heal.call_count) == (None, 1)


def test_steps_are_told_when_they_begin_and_then_now_and_then(tmp_path: Path) -> None:
    told, clock = list[str](), HandClock()
    log = StepLog(tmp_path / "log", told.append, clock.now)
    for number in log.track(range(4), "training", "step", 9, 5, lambda: "loss 2"):
        clock.advance(EVERY_S - 1.0 if number == 2 else 1.0)
    for share in (0.25, 0.5):
        log.progress("fit", share)
    assert told == [
        "training: step 6 of 9, loss 2",
        "training: step 8 of 9, loss 2",
        "training: 9 steps, loss 2",
        "fit: 25%",
    ]
    lines = [line.partition(" ") for line in (tmp_path / "log").read_text().splitlines()]
    assert [what for _, _, what in lines] == told
    assert all(when.endswith("Z") for when, _, _ in lines)
