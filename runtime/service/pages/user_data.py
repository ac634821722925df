"""Reads a range of the source's pages for their bytes, and restores lost ones from parity, group by group."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from lightpage.codec.page_bytes import PageBytes
from lightpage.codec.volume import Successor, Volume, restore_group
from lightpage.errors import LightpageError, LostPageError, PageError, SourceError
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.monitoring.stages import Stage, Stages

GROUPS = 4
"""Groups whose pages are held: pages of a few files may take turns. A group of full-size pages is 40 MB."""


@dataclass(frozen=True)
class DataPage:
    """One page of a range.

    Attributes:
        source_page: its number in the source; None where its bytes were restored.
        found: what it gave; None where it could not be decoded.
        error: why not.
        model_version: what decoded it, or the last page of its group; empty where nothing did.
        stages: times it; None where its bytes were restored.
    """

    source_page: int | None
    found: PageBytes | None
    error: LightpageError | None = None
    model_version: str = ""
    stages: Stages | None = None


@dataclass
class _Group:
    """The pages of one group that were read."""

    volume: Volume
    number: int
    last: PageBytes
    model_version: str
    pages: dict[int, bytes] = field(default_factory=dict)

    def restored(self) -> Iterator[DataPage]:
        """Data pages of the group that were not read, where the others give them."""
        numbers = self.volume.numbers_in(self.number)[: self.volume.data_in(self.number)]
        absent = [number for number in numbers if number not in self.pages]
        whole = restore_group(self.volume, self.number, self.pages) if absent else None
        if whole is None or self.last.header is None:
            return
        for number in absent:
            header = replace(self.last.header, page=number)
            page = PageBytes(header, whole[numbers.index(number)], self.last.file, None, 0.0, 0, 0, 0, 0.0)
            yield DataPage(None, page, model_version=self.model_version)


def read_data(
    plane: DataPlane, first: int, count: int, caller: Caller, timed: Callable[[], Stages] = Stages
) -> Iterator[DataPage]:
    """Read pages `first` to `first + count - 1` of the source, or to its last one.

    Args:
        plane: reads and decodes.
        first, count: of the source's pages.
        caller: who waits.
        timed: begins to time a page.

    Raises:
        BundleError: the model has no code.
        SourceError: there is no source.
        PageError: there is no page `first`.
    """
    plane.check_user_data()
    groups: dict[tuple[Volume, int], _Group] = {}
    successor = Successor()
    for index in range(first, first + count):
        stages = timed()
        try:
            answer = plane.read_page(
                index, None, caller, user_data=True, expected=successor.header, stages=stages
            ).answer
        except (LostPageError, SourceError) as error:
            successor = successor.after()
            stages.begin(Stage.RESPOND)
            yield DataPage(index, None, error, stages=stages)
            continue
        except PageError:
            if index == first:
                raise
            break
        found = answer.user_data
        assert found is not None  # it was asked for
        volume = Volume.of_page(found)
        if volume is not None and found.header is not None and found.data is not None:
            key = volume, found.header.page // volume.group_pages
            if key not in groups and len(groups) == GROUPS:
                yield from groups.pop(next(iter(groups))).restored()
            group = groups.pop(key, None) or _Group(*key, found, answer.model_version)
            groups[key] = group  # the one used last is the last to go
            group.last, group.model_version = found, answer.model_version
            group.pages[found.header.page] = found.data
            if len(group.pages) == len(volume.numbers_in(group.number)):
                del groups[key]  # nothing is missing
            successor = Successor(volume, found.header)
        successor = successor.after()
        yield DataPage(index, found, model_version=answer.model_version, stages=stages)
    for group in groups.values():
        yield from group.restored()
