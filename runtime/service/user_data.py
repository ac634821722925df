"""Reads a range of the source's pages for their bytes, and restores lost ones from parity, group by group."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from lightpage.codec.header import Header
from lightpage.codec.page_codec import PageBytes
from lightpage.codec.volume import Volume, restore_group
from lightpage.errors import LightpageError
from runtime.errors import LostPageError, SourceError
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane


@dataclass(frozen=True)
class DataPage:
    """One page of a range.

    Attributes:
        source_page: its number in the source; None where its bytes were restored.
        found: what it gave; None where it could not be decoded.
        error: why not.
        model_version: what decoded it; empty where nothing did.
    """

    source_page: int | None
    found: PageBytes | None
    error: LightpageError | None = None
    model_version: str = ""


class _Group:
    """The pages of one group that were read, in one volume."""

    def __init__(self) -> None:
        self.volume: Volume | None = None
        self.number = -1
        self.pages: dict[int, bytes] = {}

    def holds(self, volume: Volume, number: int) -> bool:
        return self.volume == volume and self.number == number

    def restored(self, template: PageBytes | None) -> Iterator[PageBytes]:
        """Data pages of the group that were not read, where the others give them."""
        if self.volume is None or template is None or template.header is None:
            return
        numbers = self.volume.numbers_in(self.number)[: self.volume.data_in(self.number)]
        absent = [number for number in numbers if number not in self.pages]
        whole = restore_group(self.volume, self.number, self.pages) if absent else None
        for number in absent if whole is not None else ():
            assert whole is not None  # for the type checker, which does not follow the line above
            header = replace(template.header, page=number)
            yield replace(template, header=header, data=whole[numbers.index(number)], corrected=0)


def read_data(plane: DataPlane, first: int, count: int, caller: Caller) -> Iterator[DataPage]:
    """Read pages `first` to `first + count - 1` of the source.

    Args:
        plane: reads and decodes.
        first, count: of the source's pages.
        caller: who waits.

    Raises:
        BundleError: the model has no code.
        SourceError: there is no source.
        PageError: no such page.
    """
    plane.levels_of(0, user_data=True)
    _ = plane.source
    group, last, expected = _Group(), None, None
    for index in range(first, first + count):
        try:
            answer = plane.read_page(index, None, caller, user_data=True, expected=expected).answer
        except (LostPageError, SourceError) as error:
            expected = _following(group.volume, expected)
            yield DataPage(index, None, error)
            continue
        found = answer.user_data
        if found is None:
            raise SourceError(f"page {index}", "no user data", "user data, as was asked for")
        if found.data is not None and found.header is not None:
            volume = Volume(
                found.header.volume, found.header.volume_bytes, len(found.data), found.data_pages, found.parity_pages
            )
            number = found.header.page // volume.group_pages
            if not group.holds(volume, number):
                yield from (DataPage(None, page, model_version=answer.model_version) for page in group.restored(last))
                group = _Group()
                group.volume, group.number = volume, number
            group.pages[found.header.page] = found.data
            last = found
        expected = _following(group.volume, found.header or expected)
        yield DataPage(index, found, model_version=answer.model_version)
    yield from (DataPage(None, page) for page in group.restored(last))


def _following(volume: Volume | None, header: Header | None) -> Header | None:
    """The header of the page after one; None where that is not known."""
    if volume is None or header is None or header.volume != volume.id:
        return None
    following = volume.following(header.page)
    return None if following is None else replace(header, page=following)
