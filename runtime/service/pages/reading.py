"""Reads pages of the service's own source: one as symbols, or a range for its bytes, lost ones restored from parity."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.page_bytes import Header, Loss, PageBytes
from lightpage.codec.volume import Successor, Volume, restore_group
from lightpage.errors import (
    BundleError,
    BusyError,
    FramesDisagreeError,
    InvalidInputError,
    LightpageError,
    LostPageError,
    PageError,
    SourceError,
)
from lightpage.page.pilots import Pilots
from lightpage.runtime.archives.recordings.read_ahead import beside
from lightpage.runtime.device.acquisition.source import FrameSource, Shot, own_fault
from lightpage.runtime.model.decoding.turns import Turn, Turns
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import Answer, DataPlane, Seen, levels_for, observed
from lightpage.runtime.service.models.loader import Model
from lightpage.runtime.service.monitoring.monitor import SHOWS_DEVICE
from lightpage.runtime.service.stages import Stage, Stages

GROUPS = 4
"""Groups whose pages are held: pages of a few files may take turns. A group of full-size pages is 40 MB."""


@dataclass(frozen=True)
class ReadAnswer:
    """An answer for a page of the source, with what the source knows of it, and the model that has decoded it."""

    answer: Answer
    shot: Shot
    pilot_mask: NDArray[np.bool_]
    model: Model


@dataclass(frozen=True)
class DataPage:
    """A page of a range.

    Attributes:
        source_page: its number in the source; None where its bytes were restored.
        found: what it gave; None where it could not be decoded.
        error: why not.
        model_version: what decoded it, or the last page of its group; empty where nothing did.
        stages: times it; None where its bytes were restored.
        again: reads its bytes as those of the page that should be there; None where nothing was decoded.
    """

    source_page: int | None
    found: PageBytes | None
    error: LightpageError | None = None
    model_version: str = ""
    stages: Stages | None = None
    again: Callable[[Header], PageBytes] | None = None


@dataclass
class _Group:
    """The pages of one group that were read."""

    volume: Volume
    number: int
    last: PageBytes
    model_version: str
    pages: dict[int, bytes] = field(default_factory=dict)

    @property
    def absent(self) -> list[int]:
        """Numbers of the data pages that were not read."""
        numbers = self.volume.numbers_in(self.number)[: self.volume.data_in(self.number)]
        return [number for number in numbers if number not in self.pages]

    def restored(self) -> Iterator[DataPage]:
        """Data pages of the group that were not read, where the others give them."""
        numbers, absent = self.volume.numbers_in(self.number), self.absent
        whole = restore_group(self.volume, self.number, self.pages) if absent else None
        if whole is None or self.last.header is None:
            return
        for number in absent:
            header = replace(self.last.header, page=number)
            page = PageBytes(header, whole[numbers.index(number)], self.last.file, None, 0.0, 0, 0, 0, 0.0)
            yield DataPage(None, page, model_version=self.model_version)


def read_page(
    plane: DataPlane,
    page: int | None,
    levels: int | None,
    caller: Caller,
    *,
    user_data: bool = False,
    expected: Header | None = None,
    stages: Stages | None = None,
    order: Turn | None = None,
) -> ReadAnswer:
    """Read a page from the source and decode it; `levels` None stands for the source's own, or the code's.

    Args:
        plane: the service.
        page: which; the next one if None.
        levels: M.
        caller: who waits.
        user_data: whether to read the page's bytes too.
        expected: the page of its volume that should be there, where that is known.
        stages: times the page.
        order: order of the pages of its call, in which they are taken from the source; by default it is alone.

    Raises:
        BundleError, InvalidInputError: see `decode`.
        SourceError: no source, or one that is damaged or dark.
        PageError: no such page, or an impossible level count; else as `decode`.
    """
    source, stages, monitor = plane.source, stages or Stages(), plane.monitors.device
    stages.begin(Stage.QUEUE)
    # The slot first: pages that wait for one shall not be read yet, nor lie in memory.
    with order or Turns().take() as order, plane.slot(caller):
        model, begun = plane.models.current, time.perf_counter()
        seen = Seen(f"{'next page' if page is None else f'page {page}'} of {source.name}", page, model.version)
        with observed(plane.monitors.told_by(monitor), seen):
            stages.begin(Stage.RECEIVE)
            found = _shot(plane, source, page, caller, user_data)
            with plane.place(model, caller) as place:
                order.close()
                subject = f"page {found.page_index} of {source.name}"
                seen.note(subject=subject, page_index=found.page_index, levels=source.levels)
                seen.note(pair=found.pair, infos=found.infos, symbols=found.symbols, pilot_mask=found.pilot_mask)
                mask = model.decoder.bundle.pilot_mask if found.pilot_mask is None else found.pilot_mask
                levels = levels_for(model.decoder, levels, source.levels, user_data)
                if user_data and not np.array_equal(mask, model.decoder.bundle.pilot_mask):
                    raise SourceError(f"{source.name}: pilots", "other places", "those of the model in service")
                if user_data and found.symbols is not None and levels != source.levels:
                    raise SourceError(f"{subject}: levels", source.levels, f"{levels}, as the code in service has")
                # Pilots are what was written, whatever level count the caller wants to see.
                if found.symbols is not None:
                    pilots = Pilots.of_symbols(mask, found.symbols, model.decoder.bundle.levels(source.levels))
                else:
                    own = model.decoder
                    pilots = own.written_pilots(levels) if user_data else own.pilots(source.levels, mask)
                with own_fault(f"{subject}: "), plane.optics(user_data):
                    decoded = plane.decode(model, place, found.pair, levels, pilots, subject, stages, monitor)
            data = plane.user_data(model, decoded, stages, monitor, expected) if user_data else None
            seen.note(page=decoded, user_data=data)
        plane.took(model, time.perf_counter() - begun, decoded.timings)
    return ReadAnswer(plane.answer(decoded, model, stages, data, monitor), found, mask, model)


def _shot(plane: DataPlane, source: FrameSource, page: int | None, caller: Caller, user_data: bool) -> Shot:
    """A page of the source; a lost shot is counted."""
    try:
        with own_fault(), plane.optics(user_data):
            return source.shot(min(source.shot_s, caller.seconds_left()), page)
    except LostPageError as error:
        plane.metrics.lost(error)
        raise


@dataclass
class Unread:
    """Pages of a range that came to nothing, and might be read by a model that fits the device.

    Attributes:
        model_version: version of the model that lost the last of them.
        pages: by their numbers in the source, the page of its volume that each is or should be, None where unknown.
        groups: groups that lack pages, with those that were read.
    """

    model_version: str = ""
    pages: dict[int, Header | None] = field(default_factory=dict)
    groups: dict[tuple[Volume, int], _Group] = field(default_factory=dict)

    def add(self, index: int, header: Header | None, version: str) -> None:
        """Take in a page."""
        self.pages[index], self.model_version = header, version

    def told(self, index: int, header: Header) -> None:
        """A page was read, which says what those before it should have been."""
        for before, known in self.pages.items():
            if known is None and 0 < index - before <= header.page:
                self.pages[before] = replace(header, page=header.page - (index - before))

    def group_of(self, page: DataPage) -> _Group | None:
        """The group that a page belongs to, with that page; None where it says of none."""
        found = page.found
        volume = None if found is None else Volume.of_page(found)
        if volume is None or found is None or found.header is None or found.data is None:
            return None
        key = volume, found.header.page // volume.group_pages
        group = self.groups.pop(key, None) or _Group(*key, found, page.model_version)
        self.groups[key] = group  # the one used last is the last to go
        group.last, group.model_version = found, page.model_version
        group.pages[found.header.page] = found.data
        return group

    def restored(self, group: _Group) -> Iterator[DataPage]:
        """Pages that the others of a group give. Where none of its data is missing then, nor are its parity pages."""
        absent, pages = group.absent, list(group.restored())
        if len(pages) == len(absent):
            del self.groups[group.volume, group.number]
            gone = {(group.volume.id, number) for number in group.volume.numbers_in(group.number)}
            self.pages = {
                i: page for i, page in self.pages.items() if page is None or (page.volume, page.page) not in gone
            }
        yield from pages


def read_data(
    plane: DataPlane,
    first: int,
    count: int,
    caller: Caller,
    timed: Callable[[], Stages] = Stages,
    unread: Unread | None = None,
) -> Iterator[DataPage]:
    """Read pages `first` to `first + count - 1` of the source, or to its last one.

    Args:
        plane: reads and decodes.
        first, count: first page and number of the source's pages.
        caller: who waits.
        timed: begins to time a page.
        unread: takes the pages that came to nothing.

    Raises:
        BundleError: the model has no code.
        SourceError: there is no source.
        PageError: there is no page `first`.
    """
    _ = plane.source, plane.models.current.decoder.page_codec  # they are there
    successor, unread, turns = Successor(), unread or Unread(), Turns()
    known, waiting = (first, successor), plane.waiting(caller)

    def read(at: tuple[int, Turn]) -> tuple[DataPage, Header | None]:
        (index, order), (since, expected) = at, known
        for _ in range(since, index):
            expected = expected.after()
        stages = timed()
        try:
            return _data_page(plane, index, expected.header, caller, stages, order), expected.header
        except PageError:
            stages.is_dropped = index > known[0]  # nobody has asked for it yet
            raise

    numbers = ((index, turns.take(waiting)) for index in range(first, first + count))
    for (index, _), result in beside(read, numbers, plane.ahead(), lambda at: at[1].close()):
        try:
            page, expected = result()
        except PageError:
            if index == first:
                raise
            break
        if _lacks_header(page) and page.again and successor.header not in (None, expected):  # it was not known yet
            page = replace(page, found=page.again(successor.header))
        page = replace(page, again=None)
        oldest = next(iter(unread.groups.values()), None)
        group = unread.group_of(page)
        if group is not None and group.last.header is not None:
            if oldest is not None and len(unread.groups) > GROUPS:
                yield from unread.restored(oldest)
                unread.groups.pop((oldest.volume, oldest.number), None)
            if len(group.pages) == len(group.volume.numbers_in(group.number)):
                del unread.groups[group.volume, group.number]  # nothing is missing
            unread.told(index, group.last.header)
            successor = Successor(group.volume, group.last.header)
        elif _curable(page):
            header = page.found.header if page.found is not None else None
            unread.add(index, header or successor.header, page.model_version or plane.models.current.version)
        successor = successor.after()
        known = index + 1, successor
        yield page
    for group in list(unread.groups.values()):
        yield from unread.restored(group)


def read_again(
    plane: DataPlane, unread: Unread, caller: Caller, timed: Callable[[], Stages] = Stages
) -> Iterator[DataPage]:
    """Read those pages of a range once more that came to nothing; yields each, and those that their groups give then.

    The caller knows that they are lost: it ends early where there is no room or time, or another model has no code.

    Args:
        plane, caller, timed: as for `read_data`.
        unread: pages of the range that gave no bytes.
    """
    for index, expected in list(unread.pages.items()):
        try:
            page = _data_page(plane, index, expected, caller, timed())
        except (BundleError, BusyError, InvalidInputError):
            return
        unread.group_of(page)
        yield page
    for group in list(unread.groups.values()):
        yield from unread.restored(group)


def _data_page(
    plane: DataPlane, index: int, expected: Header | None, caller: Caller, stages: Stages, order: Turn | None = None
) -> DataPage:
    """Read a page of a range.

    Raises:
        PageError: there is none.
    """
    try:
        read = read_page(plane, index, None, caller, user_data=True, expected=expected, stages=stages, order=order)
        answer = read.answer
    except (LostPageError, SourceError) as error:
        stages.begin(Stage.RESPOND)
        return DataPage(index, None, error, stages=stages)
    assert answer.user_data is not None  # it was asked for
    again = partial(read.model.decoder.page_codec.decode, answer.page.phase, answer.page.concentration)
    return DataPage(index, answer.user_data, model_version=answer.model_version, stages=stages, again=again)


def _lacks_header(page: DataPage) -> bool:
    return page.found is not None and page.found.loss is Loss.HEADER


def _curable(page: DataPage) -> bool:
    """Return whether a page that came to nothing shows the device, so that a model which fits that may read it."""
    if page.found is not None:
        return page.found.loss in (Loss.HEADER, Loss.BODY, Loss.CHECKSUM)
    if isinstance(page.error, LostPageError):
        return page.error.reason in SHOWS_DEVICE
    return page.error is not None and isinstance(page.error.__cause__, FramesDisagreeError)
