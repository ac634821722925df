"""A file on pages: groups of data pages with parity pages, so that pages that are lost come back.

A volume is a file's bytes, cut into data pages of equal size, the last one filled up with zeros. k data pages and m
parity pages make a group. Page number g (k + m) + i is data page g k + i where i < k, else parity page i - k of group
g. Data pages beyond the file's end have numbers but are not written; they count as zeros.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from io import SEEK_END
from typing import IO

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.checksum import Checksum
from lightpage.codec.erasure import check_group, parity_of, restore
from lightpage.codec.header import check_volume
from lightpage.codec.page_bytes import FileFacts, Header, PageBytes
from lightpage.codec.page_codec import PageCodec
from lightpage.errors import InvalidInputError

DATA_PAGES, PARITY_PAGES = 60, 4
"""Pages of a group, unless told otherwise: enough parity for a page in a hundred to be lost."""

_PAGES_AT_ONCE = 32
_READ_BYTES = 1 << 20


@dataclass(frozen=True)
class Volume:
    """Volume: the layout of a file on pages.

    Attributes:
        id: a number that tells files on one medium apart.
        file_bytes: length of the file.
        page_bytes: user bytes of a page.
        data_pages, parity_pages: k and m of a group.
        checksum: CRC-32C of the file.
    """

    id: int
    file_bytes: int
    page_bytes: int
    data_pages: int
    parity_pages: int
    checksum: int = 0

    def __post_init__(self) -> None:
        """Check that the file can be numbered.

        Raises:
            InvalidInputError: a group, an id or a file that is too large.
        """
        check_group(self.data_pages, self.parity_pages)
        check_volume(self.id, self.file_bytes, self.groups * self.group_pages)

    @property
    def group_pages(self) -> int:
        """k + m."""
        return self.data_pages + self.parity_pages

    @property
    def file_pages(self) -> int:
        """Data pages that hold bytes of the file; one for an empty file."""
        return max(1, -(-self.file_bytes // self.page_bytes))

    @property
    def groups(self) -> int:
        """Groups of the whole file."""
        return -(-self.file_pages // self.data_pages)

    def data_in(self, group: int) -> int:
        """Data pages of a group that are written."""
        return min(self.data_pages, self.file_pages - group * self.data_pages)

    def numbers_in(self, group: int) -> list[int]:
        """Numbers of the pages of a group that are written, data first."""
        first = group * self.group_pages
        data = range(first, first + self.data_in(group))
        return [*data, *range(first + self.data_pages, first + self.group_pages)]

    def bytes_of(self, numbers: Iterable[int]) -> list[tuple[int, int]]:
        """Return the byte ranges [first, end) that data pages hold, adjacent ones merged."""
        spans: list[tuple[int, int]] = []
        for number in sorted(numbers):
            group, place = divmod(number, self.group_pages)
            start = (group * self.data_pages + place) * self.page_bytes
            end = min(start + self.page_bytes, self.file_bytes)
            begin = spans.pop()[0] if spans and spans[-1][1] == start else start
            spans.append((begin, end))
        return spans

    @property
    def pages(self) -> int:
        """Pages that are written."""
        return self.file_pages + self.groups * self.parity_pages

    def holds(self, page: int) -> bool:
        """Return whether a page of this number is written."""
        group, place = divmod(page, self.group_pages)
        return group < self.groups and (place >= self.data_pages or place < self.data_in(group))

    def following(self, page: int) -> int | None:
        """The number of the page that is written after `page`, None after the last."""
        group = page // self.group_pages
        later = [number for number in self.numbers_in(group) if number > page]
        return later[0] if later else (group + 1) * self.group_pages if group + 1 < self.groups else None

    def to_json(self) -> dict[str, int]:
        """Return the fields that a file of pages states about its volume, as JSON."""
        return {
            "volume": self.id,
            "file_bytes": self.file_bytes,
            "page_bytes": self.page_bytes,
            "data_pages": self.data_pages,
            "parity_pages": self.parity_pages,
            "checksum": self.checksum,
        }

    @property
    def facts(self) -> FileFacts:
        """Facts about the file that every page states."""
        return FileFacts(self.data_pages, self.parity_pages, self.checksum)

    @classmethod
    def of_page(cls, page: PageBytes) -> Volume | None:
        """The volume that a page says it belongs to; None of a lost page, or where no volume is such.

        Args:
            page: page that was read.
        """
        header, data, file = page.header, page.data, page.file
        if header is None or data is None or file is None:
            return None
        try:
            told = cls(header.volume, header.volume_bytes, len(data), file.data_pages, file.parity_pages, file.checksum)
        except InvalidInputError:
            return None
        return told if told.holds(header.page) else None

    @classmethod
    def of_file(cls, file: IO[bytes], volume_id: int, page_bytes: int, data_pages: int, parity_pages: int) -> Volume:
        """The volume of a file, which is read once for its size and checksum and stands at its start again.

        Raises:
            InvalidInputError: see the constructor.
        """
        start, check = file.tell(), Checksum()
        size = file.seek(0, SEEK_END) - start
        volume = cls(volume_id, size, page_bytes, data_pages, parity_pages)  # may refuse it before it is read
        file.seek(start)
        while part := file.read(_READ_BYTES):
            check.add(part)
        file.seek(start)
        return replace(volume, checksum=check.value)


@dataclass(frozen=True)
class Successor:
    """Successor of the pages that were read: the page that should come next.

    Attributes:
        volume: volume that the last page belongs to; None where nothing is known.
        header: header of the page that should come; None where nothing is known, or after the last one.
    """

    volume: Volume | None = None
    header: Header | None = None

    def after(self) -> Successor:
        """Return the successor of the page that should come next."""
        if self.volume is None or self.header is None:
            return Successor()
        following = self.volume.following(self.header.page)
        return Successor(self.volume, None if following is None else replace(self.header, page=following))


def encode_volume(
    codec: PageCodec, volume: Volume, file: IO[bytes], pilots: NDArray[np.uint8]
) -> Iterator[NDArray[np.uint8]]:
    """Pages of a file, some at a time, in the order of their numbers.

    Args:
        codec: codec of the pages.
        volume: how the file lies on them.
        file: read once, from where it stands.
        pilots: levels of the pilots.

    Yields:
        uint8 [pages, ny, nx].

    Raises:
        InvalidInputError: the file is shorter or longer than the volume says, or its bytes have changed.
    """
    size, left, check = volume.page_bytes, volume.file_bytes, Checksum()
    for group in range(volume.groups):
        data = []
        for _ in range(volume.data_in(group)):
            part = file.read(min(size, left))
            if len(part) != min(size, left):
                read = volume.file_bytes - left + len(part)
                raise InvalidInputError("file", f"{read} bytes", f"{volume.file_bytes}, as it had before")
            left -= len(part)
            check.add(part)
            data.append(part.ljust(size, b"\0"))
        unwritten = [bytes(size)] * (volume.data_pages - len(data))
        pages = data + parity_of(data + unwritten, volume.parity_pages)
        yield from _encoded(codec, volume, volume.numbers_in(group), pages, pilots)
    if file.read(1):
        raise InvalidInputError("file", "more bytes", f"{volume.file_bytes}, as it had before")
    if check.value != volume.checksum:
        raise InvalidInputError("file", "other bytes", "the ones that it had before: it was written to meanwhile")


def _encoded(
    codec: PageCodec, volume: Volume, numbers: Sequence[int], pages: Sequence[bytes], pilots: NDArray[np.uint8]
) -> Iterator[NDArray[np.uint8]]:
    for start in range(0, len(pages), _PAGES_AT_ONCE):
        some = slice(start, start + _PAGES_AT_ONCE)
        headers = [Header(codec.code.id, volume.id, number, volume.file_bytes) for number in numbers[some]]
        data = np.stack([np.frombuffer(page, np.uint8) for page in pages[some]])
        yield codec.encode(headers, data, volume.facts, pilots)


def restore_group(volume: Volume, group: int, pages: dict[int, bytes]) -> list[bytes] | None:
    """The data pages of a group that are written, restored where they are lost; None where too many are.

    Args:
        volume: volume of the file.
        group: number of the group.
        pages: pages that were read, by page number.
    """
    first = group * volume.group_pages
    places = {number - first: page for number, page in pages.items()}
    written = volume.data_in(group)
    if all(place in places for place in range(written)):
        return [places[place] for place in range(written)]
    places |= {place: bytes(volume.page_bytes) for place in range(written, volume.data_pages)}
    whole = restore(places, volume.data_pages, volume.parity_pages)
    return None if whole is None else whole[:written]
