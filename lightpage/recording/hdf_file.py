"""A file that HDF5 writes to, on a disk that may be full."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any

from lightpage.errors import RecordingError
from lightpage.failures import os_failure
from lightpage.files import lock
from lightpage.recording.hdf5 import retried
from lightpage.systems import open_file


def open_to_write(
    path: Path, subject: str, expected: str = "a file that can be written", *, keep: bool = False
) -> HdfFile:
    """The file that HDF5 writes to; arguments as there, and for the error message.

    Raises:
        RecordingError: it cannot be written, or another process is writing it.
        StorageError, SurroundingsError: storage fails, or a resource is short.
    """
    try:
        return HdfFile(path, keep=keep)
    except BlockingIOError:
        got = "a file that another process is writing now"
        raise RecordingError(subject, got, f"{expected}: wait for its end") from None
    except OSError as error:
        raise os_failure(subject, error, expected, RecordingError) from None


class HdfFile(FileIO):
    """The file that HDF5 writes to, locked.

    It hides from HDF5 that a write has failed, after which HDF5 could neither close the file nor safely go on. What
    storage refuses for a moment is tried again. After the first failure the file is put back to what it was at the last
    `check`, and what is written later is dropped: HDF5 changes its tables in place, and half of that is no file.

    Args:
        path: of the file; made if it is not there.
        keep: whether what is in it stays.

    Raises:
        OSError: the file cannot be written, or another process is writing it.
    """

    def __init__(self, path: Path, *, keep: bool = False) -> None:
        super().__init__(open_file(path), "r+")
        self._error: OSError | None = None
        self._before: list[tuple[int, bytes]] = []
        """Where the file has been overwritten since the last `check`, and what was there."""
        try:
            lock(self.fileno(), f"file {path}")
            if not keep:
                super().truncate(0)
            self._size = os.fstat(self.fileno()).st_size
        except OSError:
            self.close()
            raise

    def readinto(self, buffer: Any) -> int:
        """Read, again where storage fails for a moment."""
        return retried(lambda: FileIO.readinto(self, buffer))

    def write(self, data: Any) -> int:
        """Write all of `data`, or from some failure on nothing."""
        left = memoryview(data)
        size = len(left)

        def write_some() -> int:
            return FileIO.write(self, left)

        try:
            self._keep(self.tell(), size)
            while left and self._error is None:
                left = left[retried(write_some) :]
        except OSError as error:
            self._fail(error)
        return size

    def truncate(self, size: int | None = None) -> int:
        """Set the file's length, or from some failure on do nothing."""
        try:
            end = self.tell() if size is None else size
            self._keep(end, self._size - end)
            return retried(lambda: FileIO.truncate(self, end)) if self._error is None else 0
        except OSError as error:
            self._fail(error)
            return 0

    def check(self) -> None:
        """Raise what has failed; else what is in the file now is what a later failure leaves."""
        if self._error is not None:
            raise self._error
        self._before.clear()
        self._size = os.fstat(self.fileno()).st_size

    def give_up(self) -> None:
        """Put the file back to what it was at the last `check`, and drop what is written from here on."""
        self._fail(self._error or OSError(errno.ECANCELED, os.strerror(errno.ECANCELED)))

    def _keep(self, start: int, size: int) -> None:
        size = min(size, self._size - start)
        if size > 0 and self._error is None:
            place = self.tell()
            self._before.append((start, retried(partial(self._read_at, start, size))))
            self.seek(place)

    def _read_at(self, start: int, size: int) -> bytes:
        os.lseek(self.fileno(), start, os.SEEK_SET)
        return os.read(self.fileno(), size)

    def _write_at(self, start: int, data: bytes) -> None:
        os.lseek(self.fileno(), start, os.SEEK_SET)
        os.write(self.fileno(), data)

    def _fail(self, error: OSError) -> None:
        self._error = error
        with suppress(OSError):  # it may fail on; then HDF5 says whether the file can be gone on with
            for start, data in reversed(self._before):
                retried(partial(self._write_at, start, data))
            os.ftruncate(self.fileno(), self._size)
