"""Collects the pages of a volume, in whatever order they come, and makes its file, whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from lightpage.codec.page_codec import PageBytes
from lightpage.codec.volume import Volume, restore_group
from lightpage.errors import InvalidInputError
from lightpage.files import move_into_place


@dataclass(frozen=True)
class Restored:
    """What became of a file's pages.

    Attributes:
        restored: numbers of data pages that parity pages gave back.
        lost: numbers of data pages that are lost; their bytes are zeros.
    """

    restored: tuple[int, ...]
    lost: tuple[int, ...]


class VolumeFile:
    """The pages of one volume, kept in `<path>.partial` until the file is made; use it in a `with` statement.

    Args:
        path: of the file.
        volume_id: whose pages are taken; those of the first page if left out.

    Raises:
        InvalidInputError: the file cannot be written.
    """

    def __init__(self, path: Path, page_bytes: int, volume_id: int | None = None) -> None:
        self.path, self._page_bytes, self._id = path, page_bytes, volume_id
        self._partial = path.with_name(path.name + ".partial")
        self.volume: Volume | None = None
        self._there: set[int] = set()
        self.repeated = 0
        """Pages that came again, with the same bytes."""
        self.foreign: dict[int, int] = {}
        """Pages of other volumes, by id."""
        try:
            self._file: IO[bytes] = self._partial.open("w+b")
        except OSError as error:
            raise InvalidInputError(f"file {self._partial}", error, "a file that can be written") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # on a full disk it tries once more to write what is not wanted any longer
            self._file.close()
        self._partial.unlink(missing_ok=True)

    def add(self, page: PageBytes) -> bool:
        """Take a page that was read; returns whether it is of this volume.

        Raises:
            InvalidInputError: it contradicts an earlier page of the volume, or there is no room for it on the disk.
        """
        header, data = page.header, page.data
        assert header is not None  # a page that was read has both
        assert data is not None
        if self._id is None:
            self._id = header.volume
        if header.volume != self._id:
            self.foreign[header.volume] = self.foreign.get(header.volume, 0) + 1
            return False
        told = Volume(header.volume, header.volume_bytes, self._page_bytes, page.data_pages, page.parity_pages)
        subject = f"volume {header.volume}: page {header.page}"
        if self.volume is None:
            self.volume = told
        if told != self.volume:
            raise InvalidInputError(subject, _shape(told), f"{_shape(self.volume)}, as its other pages say")
        if not told.holds(header.page):
            raise InvalidInputError(subject, "a number beyond the file's end", f"one of {told.pages} pages")
        if header.page in self._there:
            if self._read(header.page) != data:
                raise InvalidInputError(subject, "two pages of this number with different bytes", "one of them")
            self.repeated += 1
            return True
        self._write(header.page, data)
        self._there.add(header.page)
        return True

    def missing(self) -> list[int]:
        """Numbers of the pages of the volume that did not come."""
        if self.volume is None:
            return []
        numbers = (number for group in range(self.volume.groups) for number in self.volume.numbers_in(group))
        return [number for number in numbers if number not in self._there]

    def restore(self) -> Restored:
        """Restore data pages from parity pages where they did not come.

        Raises:
            InvalidInputError: there is no room for them on the disk.
        """
        restored: list[int] = []
        lost: list[int] = []
        for group in range(self.volume.groups if self.volume else 0):
            assert self.volume is not None
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

    def complete(self) -> None:
        """Give the file its name. Data pages that are still missing are zeros in it.

        Raises:
            InvalidInputError: no page came, or the file cannot be completed.
        """
        if self.volume is None:
            raise InvalidInputError(f"file {self.path}", "no page", "at least one")
        try:
            self._file.truncate(self.volume.file_bytes)
            self._file.close()
            move_into_place(self._partial, self.path)
        except OSError as error:
            raise InvalidInputError(f"file {self.path}", error, "a file that can be completed") from None

    def _place(self, number: int) -> int:
        """Where a page lies in the partial file: data in order, parity behind all data."""
        assert self.volume is not None
        group, place = divmod(number, self.volume.group_pages)
        if place < self.volume.data_pages:
            return (group * self.volume.data_pages + place) * self._page_bytes
        parity = group * self.volume.parity_pages + place - self.volume.data_pages
        return (self.volume.file_pages + parity) * self._page_bytes

    def _read(self, number: int) -> bytes:
        self._file.seek(self._place(number))
        return self._file.read(self._page_bytes)

    def _write(self, number: int, data: bytes) -> None:
        try:
            self._file.seek(self._place(number))
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise InvalidInputError(f"file {self._partial}", error, "room for it on the disk") from None


def _shape(volume: Volume) -> str:
    return f"{volume.file_bytes} bytes in groups of {volume.data_pages} + {volume.parity_pages} pages"


def ranges(numbers: Sequence[int]) -> str:
    """Numbers for people, neighbours together: 1-3, 7."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts)
