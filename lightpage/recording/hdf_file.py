"""A file that HDF5 writes to, on a disk that may be full."""

from __future__ import annotations

import os
from io import FileIO
from pathlib import Path
from typing import Any

from lightpage.files import lock


class HdfFile(FileIO):
    """The file that HDF5 writes to, locked.

    It hides from HDF5 that a write has failed, after which HDF5 could neither close the file nor safely go on. The
    first failure is kept for `check`, and what is written after it is dropped.

    Args:
        path: of the file; made if it is not there.
        keep: whether what is in it stays.

    Raises:
        OSError: the file cannot be written, or another process is writing it.
    """

    def __init__(self, path: Path, *, keep: bool = False) -> None:
        super().__init__(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666), "r+")
        self._error: OSError | None = None
        try:
            lock(self.fileno(), f"file {path}")
            if not keep:
                super().truncate(0)
        except OSError:
            self.close()
            raise

    def write(self, data: Any) -> int:
        """Write all of `data`, or from some failure on nothing."""
        left = memoryview(data)
        size = len(left)
        try:
            while left and self._error is None:
                left = left[super().write(left) :]
        except OSError as error:
            self._error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        """Set the file's length, or from some failure on do nothing."""
        try:
            return super().truncate(size) if self._error is None else 0
        except OSError as error:
            self._error = error
            return 0

    def check(self) -> None:
        """Raise what has failed."""
        if self._error is not None:
            raise self._error
