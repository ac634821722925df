"""A fault of storage is no finding about a page: ranges are missing until it answers, and lost on request alone."""

from __future__ import annotations

import errno
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from lightpage.errors import InvalidInputError, StorageError, SurroundingsError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from runtime.scaling import driver
from runtime.scaling.ledger import Ledger
from runtime.scaling.shard import PageState, ShardRecord, record_of
from runtime.scaling.task import Task
from tests.runtime import coded
from tests.runtime.scaling.test_bulk import PAGES, RANGE, Archive, archive
from tests.storage_fault import StorageFault

__all__ = ["archive"]

BAD_PAGE = 4


class Disk:
    """Storage that does not give a page of `a.h5` for so many tries."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.failures, self.pauses = 0, list[float]()
        self.error: Callable[[str], Exception] = lambda what: StorageError(what, "Input/output error", "data")
        frames = Recording.frames

        def read(recording: Recording, page: int) -> FramePair:
            if recording.path.name == "a.h5" and page == BAD_PAGE and self.failures > 0:
                self.failures -= 1
                raise self.error(f"recording {recording.path}: page {page}")
            return frames(recording, page)

        monkeypatch.setattr(Recording, "frames", read)
        monkeypatch.setattr(driver.run, "__kwdefaults__", {**driver.run.__kwdefaults__, "sleep": self.pauses.append})


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


OPERATIONS = ["decode", "evaluate", "recover"]


def asked(operation: str, archive: Archive) -> tuple[str, ...]:
    """Options of an operation, for which the archive is made ready."""
    if operation != "recover":
        return ()
    bundle = coded.bundle(archive.folder / "coded.zip")
    pages = coded.pages(bundle, archive.folder)
    (archive.folder / "pages.h5").unlink()
    coded.recording(archive.folder / "a.h5", pages[:PAGES])
    coded.recording(archive.folder / "b.h5", pages[PAGES:])
    return ("--no-tracking", "--bundle", str(bundle))


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_hiccup_costs_nothing(operation: str, archive: Archive, disk: Disk) -> None:
    options = asked(operation, archive)
    disk.failures = len(driver.AGAIN_S)
    status, figures = archive.run(operation, *options)
    assert (status, figures["pages_lost"], figures["pages_missing"]) == (0, 0, 0)
    assert disk.pauses == list(driver.AGAIN_S) == sorted(driver.AGAIN_S)
    again = [task.pages[0] for task in archive.tasks if task.recording.name == "a.h5"]
    assert again == [0, RANGE, 2 * RANGE, *[RANGE] * len(driver.AGAIN_S)]  # its neighbours are read once


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_range_is_missing_while_storage_fails_and_whole_afterwards(
    operation: str, archive: Archive, disk: Disk, capsys: pytest.CaptureFixture[str]
) -> None:
    options = asked(operation, archive)
    for _ in range(2):
        disk.failures = 99
        status, figures = archive.run(operation, *options)
        assert (status, figures["pages_lost"], figures["pages_missing"]) == (75, 0, RANGE)
        assert "Input/output error" in capsys.readouterr().err
    disk.failures = 0
    status, figures = archive.run(operation, *options)
    assert (status, figures["pages_lost"], figures["pages_missing"]) == (0, 0, 0)
    assert [task.pages[0] for task in archive.tasks] == [RANGE]


@pytest.mark.parametrize(("operation", "cause"), [("decode", "StorageError"), ("recover", "storage")])
def test_pages_are_given_up_on_request_alone_and_read_again_on_another(
    operation: str, cause: str, archive: Archive, disk: Disk
) -> None:
    options = asked(operation, archive)
    disk.failures = 99
    status, figures = archive.run(operation, *options, "--give-up")
    assert (figures["lost"], figures["pages_missing"]) == ({cause: 1}, 0)
    assert status == (0 if operation == "recover" else 2)  # parity completes the file
    disk.failures = 0
    assert archive.run(operation, *options)[1]["lost"] == {cause: 1}
    status, figures = archive.run(operation, *options, "--retry-lost")
    assert (status, figures["lost"], [task.pages[0] for task in archive.tasks]) == (0, {}, [RANGE])


def test_a_recording_that_vanished_is_lost_on_request(archive: Archive, disk: Disk) -> None:
    def vanish(task: Task) -> None:
        (archive.folder / "b.h5").unlink(missing_ok=True)

    archive.before_each = vanish
    status, figures = archive.run("decode")
    assert (status, figures["pages_missing"]) == (75, PAGES)
    status, figures = archive.run("decode", "--give-up", asked=False)
    assert (status, figures["pages_missing"], figures["lost"]) == (2, 0, {"RecordingError": PAGES})


def test_a_recording_that_cannot_be_opened_is_given_up_on_request_and_opened_on_another(
    archive: Archive, disk: Disk
) -> None:
    whole = (archive.folder / "b.h5").read_bytes()
    (archive.folder / "b.h5").write_bytes(b"")
    assert archive.run("decode")[0] == 75
    for _ in range(2):  # it stays given up
        status, figures = archive.run("decode", "--give-up", asked=False)
        assert (status, figures["this_run"]["given_up"], figures["this_run"]["failed"]) == (2, 1, 0)
    (archive.folder / "b.h5").write_bytes(whole)
    assert archive.run("decode", asked=False)[0] == 2
    assert archive.run("decode", "--retry-lost", asked=False)[0] == 0


@pytest.mark.parametrize(
    "error", [MemoryError(), SurroundingsError("memory", "too little", "more"), OSError(errno.EIO, "")]
)
def test_a_short_resource_is_no_finding_either(error: Exception, archive: Archive, disk: Disk) -> None:
    disk.error, disk.failures = lambda _: error, 1
    status, figures = archive.run("decode")
    assert (status, figures["pages_lost"], figures["pages_missing"]) == (0, 0, 0)


def test_what_cannot_pass_is_not_tried_again_in_the_same_run(archive: Archive, disk: Disk) -> None:
    archive.bundle.rename(archive.folder / "kept.zip")
    archive.bundle.write_bytes((archive.folder / "kept.zip").read_bytes())
    archive.before_each = lambda task: archive.bundle.unlink(missing_ok=True)
    assert archive.run("decode")[0] == 75
    assert disk.pauses == []


MISFILED = "recording a.h5: dataset 'in_phase': got Can't read data (errno = 5), wanted data that can be read"


@pytest.mark.parametrize(
    ("operation", "loss", "reason", "options", "read"),
    [
        ("decode", "UnreadableError", MISFILED, (), [RANGE]),
        ("recover", "optics", MISFILED, (), [RANGE]),
        ("decode", "BlackFrameError", "a frame without light", (), []),
        ("decode", "BlackFrameError", "a frame without light", ("--retry-lost",), [RANGE]),
    ],
)
def test_a_folder_of_version_0_1_0_is_healed_where_it_took_storage_for_a_finding(
    operation: str, loss: str, reason: str, options: tuple[str, ...], read: list[int], archive: Archive, disk: Disk
) -> None:
    more = asked(operation, archive)
    archive.run(operation, *more)
    shard = archive.out / "shards" / "000000" / f"{RANGE:08d}"
    record = ShardRecord.read(shard)
    lost = record.pages[1].model_copy(update={"state": PageState.LOST, "loss": loss, "reason": reason})
    record.model_copy(update={"pages": (record.pages[0], lost, record.pages[2])}).write(shard)
    disk.failures = 99 if read else 0
    status, figures = archive.run(operation, *more, *options)
    assert (status, figures["pages_lost"]) == ((75, 0) if read else (2, 1))
    assert record_of(shard).exists()  # it stays until there is a better one
    disk.failures = 0
    status, figures = archive.run(operation, *more, *options)
    assert ([task.pages[0] for task in archive.tasks], figures["pages_lost"]) == (read, 0 if read else 1)


def test_results_that_storage_does_not_give_are_not_called_damaged(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    archive.run("decode")
    read_bytes = Path.read_bytes

    def failing(path: Path) -> bytes:
        if path.parent.name == "000000":
            raise OSError(errno.EIO, "Input/output error")
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", failing)
    assert archive.run("decode")[0] == 75
    assert "delete it" not in capsys.readouterr().err


@pytest.mark.parametrize("opening", [False, True])
def test_real_workers_meet_a_real_fault(opening: bool, archive: Archive) -> None:
    fault = StorageFault.compiled(archive.folder, "a.h5", errno.EIO, 1, opening=opening)
    fault.flag.touch()
    words = ["bulk", "decode", str(archive.out), "--recordings", str(archive.folder / "?.h5")]
    words += ["--bundle", str(archive.bundle), "--json", str(archive.json), "--workers", "1", "--threads", "1"]
    code = "import sys; from runtime.scaling import driver; from runtime.commands import bulk; " + (
        "driver.AGAIN_S = bulk.AGAIN_S = (0.1, 0.2); from lightpage.cli.main import main; main()"
    )

    def run() -> int:
        done = subprocess.run(
            [sys.executable, "-c", code, *words], env=fault.environment, timeout=120, capture_output=True
        )
        assert not re.search("Traceback", done.stderr.decode())
        return done.returncode

    assert run() == 75
    figures = json.loads(archive.json.read_text())
    assert (figures["pages_lost"], figures["pages_read"]) == (0, PAGES)
    fault.flag.unlink()
    assert run() == 0
    assert json.loads(archive.json.read_text())["pages_read"] == 2 * PAGES


def test_the_ledger_counts_what_is_doubted_as_missing(archive: Archive) -> None:
    archive.run("decode")
    with Ledger(archive.out) as ledger:
        there = ledger.results(0)
        ledger.doubted.add(ledger.shard(0, RANGE))
        assert there - ledger.results(0) == {f"{RANGE:08d}"}


def test_a_file_that_storage_does_not_take_is_not_lost(archive: Archive, monkeypatch: pytest.MonkeyPatch) -> None:
    options = asked("recover", archive)
    with monkeypatch.context() as patch:
        for number in (errno.EIO, errno.ENOSPC):

            def failing(*_: object, number: int = number) -> None:
                raise OSError(number, "")

            patch.setattr("lightpage.codec.volume_file.move_into_place", failing)
            assert archive.run("recover", *options)[0] == 75
    status, figures = archive.run("recover", *options)
    assert (status, archive.tasks, len(figures["files"])) == (0, [], 1)


def test_what_storage_does_not_take_makes_no_page_lost(
    archive: Archive, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object) -> None:
        raise StorageError("shard", "Input/output error", "a file that can be written")

    options = asked("recover", archive)
    monkeypatch.setattr("runtime.scaling.work.write_user_bytes", failing)
    status, figures = archive.run("recover", *options, "--give-up")
    assert (status, figures["pages_lost"]) == (75, 0)


def test_what_cannot_pass_is_counted_once_beside_what_may(
    archive: Archive, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = ShardRecord.write

    def refused(record: ShardRecord, shard: Path) -> None:
        if shard.parent.name == "000000" and shard.name.startswith("00000000"):
            raise InvalidInputError("shard", "refused", "another")
        write(record, shard)

    monkeypatch.setattr(ShardRecord, "write", refused)
    disk.failures = len(driver.AGAIN_S)
    status, figures = archive.run("decode")
    assert (status, figures["this_run"]["failed"], figures["pages_missing"]) == (75, 1, RANGE)
