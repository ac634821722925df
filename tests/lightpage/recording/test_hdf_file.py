"""A disk that fails while a file is written: what fails for a moment costs nothing, and pages that were whole stay."""

import errno
from io import FileIO
from pathlib import Path

import numpy as np
import pytest

from lightpage.errors import LightpageError, NoRoomError, StorageError, SurroundingsError
from lightpage.page.symbols import random_symbols
from lightpage.recording import hdf5, hdf_file
from lightpage.recording.pages import Pages, PagesWriter
from lightpage.recording.reader import Recording
from lightpage.recording.unfinished import Identity, pages_there, partial_path
from lightpage.recording.writer import RecordingWriter
from tests.clock import HandClock
from tests.lightpage.recording.test_recording import LEVELS, random_frames, small_profile

PROFILE = small_profile()
SYMBOLS = random_symbols(PROFILE, LEVELS, 4, np.random.default_rng(1))


class Disk(FileIO):
    """Writes and reads as the system does, but for some."""

    writes = 0
    bad_writes = range(0)
    bad_reads = 0
    error = errno.EIO

    def write(self, data: object) -> int:
        Disk.writes += 1
        if Disk.writes - 1 in Disk.bad_writes:
            raise OSError(Disk.error, "fails")
        return FileIO.write(self, data)  # type: ignore[arg-type]

    def readinto(self, buffer: object) -> int | None:
        if Disk.bad_reads:
            Disk.bad_reads -= 1
            raise OSError(Disk.error, "fails")
        return FileIO.readinto(self, buffer)  # type: ignore[arg-type]


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> type[Disk]:
    for name, value in {"writes": 0, "bad_writes": range(0), "bad_reads": 0, "error": errno.EIO}.items():
        monkeypatch.setattr(Disk, name, value)
    monkeypatch.setattr(hdf_file, "FileIO", Disk)
    monkeypatch.setattr(hdf5, "clock", HandClock())
    return Disk


def writer(path: Path) -> RecordingWriter:
    return RecordingWriter(path, PROFILE, LEVELS, 12, random_frames(100), resume=True)


def write(path: Path, pages: int = 4) -> None:
    with writer(path) as recording:
        for page in range(recording.pages, pages):
            recording.append(SYMBOLS[page], random_frames(page))


def check(path: Path, pages: int = 4) -> None:
    with Recording.open(path) as recording:
        assert recording.pages == pages
        for page in range(pages):
            np.testing.assert_array_equal(recording.frames(page).quadrature, random_frames(page).quadrature)
            np.testing.assert_array_equal(recording.symbols(page), SYMBOLS[page])


def test_writes_that_fail_for_a_moment_cost_nothing(tmp_path: Path, disk: type[Disk]) -> None:
    disk.bad_writes = range(0, 1000, 2)
    write(tmp_path / "r.h5")
    check(tmp_path / "r.h5")


@pytest.mark.parametrize(
    ("number", "kind"), [(errno.EIO, StorageError), (errno.ENOSPC, NoRoomError), (errno.EDQUOT, NoRoomError)]
)
def test_wherever_writing_fails_the_pages_before_stay(
    tmp_path: Path, disk: type[Disk], number: int, kind: type[LightpageError]
) -> None:
    write(tmp_path / "whole.h5", 2)
    first = disk.writes
    write(tmp_path / "whole.h5", 3)
    writes, disk.error = disk.writes - first, number
    for bad in range(first - 4, writes + 2, 1 if number == errno.EIO else 3):
        path = tmp_path / f"{bad}.h5"
        disk.writes, disk.bad_writes = 0, range(bad, 10_000)
        with pytest.raises(kind) as caught:
            write(path)
        disk.bad_writes = range(0)
        if kept := pages_there(path, Identity(PROFILE, LEVELS, 12)):
            assert f"{kept} page" in str(caught.value)
            assert partial_path(path).name in str(caught.value)
        assert kept in (1, 2, 3)
        write(path)
        check(path)


def test_a_failure_to_read_does_not_begin_the_pages_anew(tmp_path: Path, disk: type[Disk]) -> None:
    path = tmp_path / "r.h5"
    with pytest.raises(KeyboardInterrupt), writer(path) as recording:  # noqa: PT012
        for page in range(2):
            recording.append(SYMBOLS[page], random_frames(page))
        raise KeyboardInterrupt
    content = partial_path(path).read_bytes()
    for good in range(6):
        reads = [0]

        def read(self: Disk, buffer: object, good: int = good, reads: list[int] = reads) -> int | None:
            reads[0] += 1
            if reads[0] > good:
                raise OSError(errno.EIO, "fails")
            return FileIO.readinto(self, buffer)  # type: ignore[arg-type]

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Disk, "readinto", read)
            with pytest.raises(StorageError):
                writer(path)
        assert partial_path(path).read_bytes() == content
    assert pages_there(path, Identity(PROFILE, LEVELS, 12)) == 2
    disk.bad_reads = 2
    write(path)
    check(path)


def test_pages_to_write_say_what_is_short_and_leave_nothing(tmp_path: Path, disk: type[Disk]) -> None:
    disk.error, disk.bad_writes = errno.ENOSPC, range(8, 10_000)
    with pytest.raises(SurroundingsError), PagesWriter(tmp_path / "p.h5", PROFILE, LEVELS, {}) as pages:
        pages.append(SYMBOLS)
    assert not list(tmp_path.iterdir())
    disk.error, disk.bad_writes, disk.writes = errno.EIO, range(0, 100, 3), 0
    with PagesWriter(tmp_path / "p.h5", PROFILE, LEVELS, {}) as pages:
        pages.append(SYMBOLS)
    with Pages.open(tmp_path / "p.h5") as read:
        np.testing.assert_array_equal(read[3], SYMBOLS[3])
