"""A folder of files of which only the last are kept, by number and by size; it goes on after a restart."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from lightpage.errors import InvalidInputError, LimitError

_PATTERN = "page-*.h5"
_UNFINISHED = "page-*.partial"


class FileRing:
    """Files whose names sort by time. It is for one thread of one process; other files of the folder are left alone.

    Args:
        folder: made if absent.
        count: files at most.
        most_bytes: of them all.

    Raises:
        InvalidInputError: the folder cannot be made.
    """

    def __init__(self, folder: Path, count: int, most_bytes: int) -> None:
        self._folder, self._count, self._most_bytes = folder, count, most_bytes
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InvalidInputError(f"folder {folder}", error, "one that can be made") from None
        for left in folder.glob(_UNFINISHED):
            with suppress(OSError):
                left.unlink()

    def add(self, time_s: float, reason: str, write: Callable[[Path], None]) -> Path:
        """Have `write` write a file, and drop the oldest ones beyond what is kept.

        Args:
            time_s: seconds since 1970.
            reason: a word, part of the name.
            write: is given the path.

        Returns:
            the file's path.

        Raises:
            LimitError: the file alone is larger than what is kept; it is dropped.
            OSError: an old file cannot be dropped; whatever `write` raises comes through.
        """
        when = datetime.fromtimestamp(time_s, UTC).strftime("%Y%m%dT%H%M%S.%f")
        path, number = self._folder / f"page-{when}-{reason}.h5", 1
        while path.exists():
            path, number = self._folder / f"page-{when}-{reason}-{number}.h5", number + 1
        self._drop(self._count - 1, self._most_bytes)  # first, since a full disk may be full of them
        try:
            write(path)
        except BaseException:
            path.with_name(path.name + ".partial").unlink(missing_ok=True)
            raise
        if (size := path.stat().st_size) > self._most_bytes:
            path.unlink()
            raise LimitError(f"file {path}", f"{size} bytes", f"at most {self._most_bytes} in all")
        self._drop(self._count, self._most_bytes)
        return path

    def files(self) -> list[Path]:
        """The files that are there, the oldest first."""
        return sorted(self._folder.glob(_PATTERN))

    def _drop(self, count: int, most_bytes: int) -> None:
        files = self.files()
        sizes = [path.stat().st_size for path in files]
        while files and (len(files) > count or sum(sizes) > most_bytes):
            files.pop(0).unlink(missing_ok=True)
            sizes.pop(0)
