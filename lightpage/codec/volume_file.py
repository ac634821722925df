"""Collects the pages of files, in whatever order they come, and makes one of the files, whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from lightpage.codec.checksum import Checksum
from lightpage.codec.page_bytes import PageBytes
from lightpage.codec.volume import Volume, restore_group
from lightpage.errors import InvalidInputError, LostDataError
from lightpage.failures import os_failure
from lightpage.files import lock, move_into_place
from lightpage.systems import open_file

MOST_VOLUMES = 16
"""Collected at once: each has a file of its own on the disk."""
_COPIED = 1 << 20


PARTIAL = ".partial"
"""End of the name of a file whose pages are still coming."""


@dataclass(frozen=True)
class Restored:
    """Numbers of a file's data pages that were missing: those restored, and those lost.

    Attributes:
        restored: numbers of data pages that parity pages gave back.
        lost: numbers of data pages that are lost; their bytes are zeros.
    """

    restored: tuple[int, ...]
    lost: tuple[int, ...]


class VolumeFile:
    """The pages of one volume, kept in a partial file beside `path` until the file is made.

    Args:
        path: path of the file.
        volume: how it lies on its pages.
        number: tells the partial files of several volumes apart.

    Raises:
        InvalidInputError: the partial file cannot be written, or another process is writing it.
    """

    def __init__(self, path: Path, volume: Volume, number: int = 0) -> None:
        self.path, self.volume = path, volume
        self._partial = path.with_name(f"{path.name}.{number}{PARTIAL}")
        self._there: set[int] = set()
        self.repeated = 0
        """Pages that came again, with the same bytes."""
        try:
            self._file = os.fdopen(open_file(self._partial), "r+b")
        except OSError as error:
            raise os_failure(f"file {self._partial}", error, "a file that can be written") from None
        try:
            lock(self._file.fileno(), f"file {self._partial}")
            self._file.truncate(0)
        except BlockingIOError:
            self._file.close()
            expected = "another name, or to wait for its end"
            raise InvalidInputError(f"file {self._partial}", "a file that another process writes", expected) from None

    def close(self) -> None:
        """Drop the partial file, if the file was not made."""
        if not self._file.closed:
            self._partial.unlink(missing_ok=True)
            with suppress(OSError):  # on a full disk it tries once more to write what is not wanted any longer
                self._file.close()

    @property
    def pages(self) -> int:
        """Pages that came, each once."""
        return len(self._there)

    def add(self, number: int, data: bytes) -> None:
        """Take a page of this volume.

        Args:
            number: number of the page.
            data: user bytes of the page.

        Raises:
            InvalidInputError: other bytes came under this number before, or there is no room for it on the disk.
        """
        if number not in self._there:
            self._write(number, data)
            self._there.add(number)
        elif self._read(number) == data:
            self.repeated += 1
        else:
            subject = f"volume {self.volume.id}: page {number}"
            raise InvalidInputError(subject, "two pages of this number with different bytes", "one of them")

    def missing(self) -> list[int]:
        """Numbers of the pages of the volume that did not come."""
        numbers = (number for group in range(self.volume.groups) for number in self.volume.numbers_in(group))
        return [number for number in numbers if number not in self._there]

    def restore(self) -> Restored:
        """Restore data pages from parity pages where they did not come.

        Raises:
            InvalidInputError: there is no room for them on the disk.
        """
        restored: list[int] = []
        lost: list[int] = []
        for group in range(self.volume.groups):
            numbers = self.volume.numbers_in(group)
            data = numbers[: self.volume.data_in(group)]
            absent = [number for number in data if number not in self._there]
            if not absent:
                continue
            pages = restore_group(self.volume, group, {n: self._read(n) for n in numbers if n in self._there})
            if pages is None:
                lost += absent
                continue
            for number in absent:
                self._write(number, pages[data.index(number)])
            restored += absent
        return Restored(tuple(restored), tuple(lost))

    def complete(self, lost: Sequence[int] = ()) -> None:
        """Give the file its name.

        Args:
            lost: data pages that are zeros in it; without any the file's checksum must hold.

        Raises:
            LostDataError: it does not: the pages are of several files.
            InvalidInputError: the file cannot be completed.
        """
        try:
            self._file.truncate(self.volume.file_bytes)
            if not lost and self._checksum() != self.volume.checksum:
                expected = "that of the file that was encoded"
                raise LostDataError(f"file {self.path}", "pages whose checksum as a file does not hold", expected)
            self._file.flush()
            move_into_place(self._partial, self.path)
            self._file.close()
        except OSError as error:
            raise os_failure(f"file {self.path}", error, "a file that can be completed") from None

    def _checksum(self) -> int:
        check = Checksum()
        self._file.seek(0)
        while part := self._file.read(_COPIED):
            check.add(part)
        return check.value

    def _place(self, number: int) -> int:
        """Return the offset of a page in the partial file, bytes: data pages in order, parity pages behind all data."""
        group, place = divmod(number, self.volume.group_pages)
        if place < self.volume.data_pages:
            return (group * self.volume.data_pages + place) * self.volume.page_bytes
        parity = group * self.volume.parity_pages + place - self.volume.data_pages
        return (self.volume.file_pages + parity) * self.volume.page_bytes

    def _read(self, number: int) -> bytes:
        try:
            self._file.seek(self._place(number))
            return self._file.read(self.volume.page_bytes)
        except OSError as error:
            raise os_failure(f"file {self._partial}", error, "a file that can be read") from None

    def _write(self, number: int, data: bytes) -> None:
        try:
            self._file.seek(self._place(number))
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise os_failure(f"file {self._partial}", error, "room for it on the disk") from None


class VolumeFiles:
    """The pages of several volumes, of which one becomes a file; use it in a `with` statement.

    Args:
        path: path of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._files: dict[Volume, VolumeFile] = {}
        self.dropped = 0
        """Pages of volumes beyond the first `MOST_VOLUMES`."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for file in self._files.values():
            file.close()

    def add(self, page: PageBytes) -> Volume | None:
        """Take a page that was read, and say whose it is; None where it names no volume that can be.

        Raises:
            InvalidInputError: see `VolumeFile`.
        """
        volume = Volume.of_page(page)
        if volume is None or page.header is None or page.data is None:
            return None
        if volume not in self._files:
            if len(self._files) == MOST_VOLUMES:
                self.dropped += 1
                return volume
            self._files[volume] = VolumeFile(self.path, volume, len(self._files))
        self._files[volume].add(page.header.page, page.data)
        return volume

    def counts(self) -> dict[Volume, int]:
        """Pages that came of each volume."""
        return {volume: file.pages for volume, file in self._files.items()}

    def chosen(self, volume_id: int | None = None, checksum: int | None = None) -> VolumeFile | None:
        """The one volume that was asked for; None where no page came at all.

        Args:
            volume_id: number of the volume; any if left out.
            checksum: checksum of its file; any if left out.

        Raises:
            InvalidInputError: none of them, or several.
        """
        fitting = [
            file
            for volume, file in self._files.items()
            if volume_id in (None, volume.id) and checksum in (None, volume.checksum)
        ]
        if len(fitting) == 1:
            return fitting[0]
        if not self._files:
            return None
        found = "; ".join(
            f"{volume.id}:{volume.checksum:08x} with {file.pages} pages of a file of {volume.file_bytes} bytes"
            for volume, file in self._files.items()
        )
        raise InvalidInputError("volume", f"pages of {found}", "one of them: --volume ID or --volume ID:CHECKSUM")


def parse_volume(volume: str | None) -> tuple[int | None, int | None]:
    """Number and checksum of a volume that is asked for.

    Raises:
        InvalidInputError: neither ID nor ID:CHECKSUM.
    """
    if volume is None:
        return None, None
    number, _, checksum = volume.partition(":")
    try:
        return int(number), int(checksum, 16) if checksum else None
    except ValueError:
        expected = "ID, or ID:CHECKSUM in hexadecimal digits"
        raise InvalidInputError("--volume", repr(volume), expected) from None


def ranges(numbers: Sequence[int]) -> str:
    """Numbers for people, neighbours together: 1-3, 7."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts)
