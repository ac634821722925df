"""The folder of a run: who may work in it, what is missing there, and what is read again."""

import errno
from pathlib import Path
from unittest.mock import Mock

import pytest

from lightpage.errors import InvalidInputError, SurroundingsError, TakenError
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import Ledger, Part
from lightpage.runtime.archives.run.shard import PageRecord, ShardRecord
from tests.clock import HandClock
from tests.runtime.archives.jobs import PAGES, RANGE, job, lost, page, source, write

FIRST, SECOND = (Part(index=index, count=2) for index in range(2))


def test_ranges_hold_every_page_once_and_those_with_a_result_are_not_missing(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    assert [task.pages for task in ledger.missing(job())] == [(0, 1, 2), (3, 4, 5), (6,)] * 2
    write(ledger.shard(1, RANGE), page(3), page(4), page(5))
    left = [(task.recording.stem, task.pages[0]) for task in ledger.missing(job())]
    assert left == [("a", 0), ("a", 3), ("a", 6), ("b", 0), ("b", 6)]
    assert ledger.results(1) == {"00000003"}
    assert [task.pages[0] for task in ledger.ranges(job(), 1, job().sources[1])] == [0, 3, 6]
    ledger.doubted.add(ledger.shard(1, RANGE))
    assert ledger.results(1) == frozenset()


def test_parts_take_every_other_recording_or_device_with_all_its_recordings() -> None:
    three = job(*(source(name) for name in "abc"))
    assert [place for place, _ in FIRST.sources(three)] == [0, 2]
    assert [place for place, _ in SECOND.sources(three)] == [1]
    fleet = job(source("a1", device="a"), source("a2", device="a"), source("b", device="b"))
    assert [(place, one.path.stem) for place, one in FIRST.sources(fleet)] == [(0, "a1"), (1, "a2")]
    assert [(place, one.path.stem) for place, one in SECOND.sources(fleet)] == [(2, "b")]


def test_a_part_is_written_as_two_numbers() -> None:
    assert str(Part.parse("1/2")) == "1/2"
    for text in ("2/2", "-1/2", "1", "a/b", "0/0", "1/2/3"):
        with pytest.raises(InvalidInputError) as error:
            Part.parse(text)
        assert (error.value.subject, error.value.got) == ("--part", repr(text))


def test_parts_work_beside_each_other_but_not_twice_nor_beside_the_whole(tmp_path: Path) -> None:
    with Ledger(tmp_path, FIRST), Ledger(tmp_path, SECOND):
        for part in (FIRST, SECOND):
            with pytest.raises(TakenError), Ledger(tmp_path, part):
                pass
        with pytest.raises(TakenError), Ledger(tmp_path):
            pass
    with Ledger(tmp_path), pytest.raises(TakenError), Ledger(tmp_path, FIRST):
        pass
    with Ledger(tmp_path):
        pass


def test_a_part_waits_ten_minutes_for_another_one_that_writes_down_what_is_asked(tmp_path: Path) -> None:
    clock = HandClock()
    start = clock.now()
    with Ledger(tmp_path, FIRST) as first, Ledger(tmp_path, SECOND, clock) as second:
        with first.question(), pytest.raises(TakenError), second.question():
            pass
        assert clock.now() - start == pytest.approx(600, abs=1)
        with second.question():
            pass


def test_storage_without_locks_is_gone_without_on_request_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fcntl.flock", Mock(side_effect=OSError(errno.ENOLCK, "No locks available")))
    monkeypatch.delenv("HDF5_USE_FILE_LOCKING", raising=False)
    with pytest.raises(SurroundingsError, match="HDF5_USE_FILE_LOCKING=FALSE"), Ledger(tmp_path):
        pass
    monkeypatch.setenv("HDF5_USE_FILE_LOCKING", "FALSE")
    with Ledger(tmp_path):
        pass


def test_what_a_killed_worker_left_is_swept_but_for_that_of_other_parts(tmp_path: Path) -> None:
    left = [Ledger(tmp_path).shard(place, 0).parent / ".00000003.h5-abc" for place in range(2)]
    for path in left:
        path.parent.mkdir(parents=True)
        path.write_bytes(b"half")
    write(Ledger(tmp_path).shard(1, 0), page(0))
    Ledger(tmp_path, SECOND).sweep(job())
    assert [path.exists() for path in left] == [True, False]
    assert Ledger(tmp_path).results(1) == {"00000000"}


@pytest.mark.parametrize(("page_1", "doubted"), [(lost(1), True), (page(1), False)])
def test_ranges_with_lost_pages_are_read_again_on_request(page_1: PageRecord, doubted: bool, tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    write(ledger.shard(0, 0), page(0), page_1, page(2))
    write(ledger.shard(0, 3), *map(page, (3, 4, 5)))
    ledger.doubt_losses(job())
    assert ledger.doubted == ({ledger.shard(0, 0)} if doubted else set())
    assert (0 in {task.pages[0] for task in ledger.missing(job(source("a")))}) == doubted


@pytest.mark.parametrize(
    ("readings", "best"),
    [
        ([[page(0, 1.0)], [page(0, 0.9)]], 1.0),
        ([[page(0, 1.0)], [page(0, 1.0)]], 1.0),
        ([[page(0, 1.0)], [page(0, 1.1)]], 1.1),
        ([[page(0, 1.0)], [lost(0)]], 1.0),
        ([[lost(0)], [lost(0)]], None),
    ],
)
def test_the_reading_counts_whose_pilots_confirm_most(
    readings: list[list[PageRecord]], best: float | None, tmp_path: Path
) -> None:
    ledger = Ledger(tmp_path)
    for number, pages in enumerate(readings):
        write(ledger.shard(0, 0, number), *pages)
    (counts,) = ledger.pages(0, 0, ledger.results(0), len(readings))
    assert counts.confirmed_bits == best
    (first,) = ledger.pages(0, 0, ledger.results(0), 1)
    assert first == readings[0][0]


def test_a_record_that_is_damaged_is_named(tmp_path: Path) -> None:
    shard = Ledger(tmp_path).shard(0, 0)
    write(shard, page(0), lost(1), lost(2, "storage"))
    record = ShardRecord.read(shard)
    assert (record.lost, record.left_out, len(record.pages)) == ({"BlackFrameError": 1, "storage": 1}, 0, 3)
    shard.with_name("00000000.json").write_text("{}")
    with pytest.raises(InvalidInputError, match=r"00000000\.json"):
        ShardRecord.read(shard)


def test_a_job_is_read_as_it_was_written(tmp_path: Path) -> None:
    assert Job.read(tmp_path) is None
    job().write(tmp_path)
    assert Job.read(tmp_path) == job()
    assert sum(each.pages for each in job().sources) == 2 * PAGES
