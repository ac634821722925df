"""Pages of a range: read in batches, looked at again where that is worth it, with all else well where it is not."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from lightpage.codec.code import Code
from lightpage.codec.page_bytes import FileFacts, Header, Loss, PageBytes
from lightpage.codec.volume import Volume
from lightpage.errors import SourceError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Call, Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.pages.page_calls import PageCalls
from lightpage.runtime.service.pages.reading import DataPage, Unread, read_again, read_data, read_page
from lightpage.runtime.service.stages import CallTimes
from tests.runtime import coded, toy
from tests.runtime.held_graph import LARGEST, HeldGraph

CODE = Code(levels=16, coded_bits=2, rate_per_mille=500)
VOLUME = Volume(id=7, file_bytes=60, page_bytes=10, data_pages=3, parity_pages=1)
"""Pages 0 to 3 and 4 to 7 are its groups; the fourth of each is of parity."""


def test_user_bytes_of_a_range_are_read_in_batches_as_page_by_page(tmp_path: Path) -> None:
    bundle = coded.bundle(tmp_path / "coded.zip")
    symbols = coded.pages(bundle, tmp_path)
    decoder = Decoder.load(bundle, threads=1)
    graph, batching, found = HeldGraph(decoder), Batching(LARGEST), []
    graph.run_together(batching)
    for each in (decoder, graph.gathering(batching)):
        times = CallTimes()
        plane = DataPlane(Models(each), coded.ShownPages(symbols, {1: coded.half_lost, 4: coded.dark}))
        pages = list(read_data(plane, 0, len(symbols) + 3, Caller(), times.page))
        times.end()
        assert times.count <= len(symbols) + 1  # of those beyond the last, the first at most
        found.append([(page.source_page, page.found and page.found.data, type(page.error)) for page in pages])
    assert found[0] == found[1]
    assert max(batching.pages.runs) > 1
    assert sum(data is not None for _, data, _ in found[0]) == len(symbols) - 1  # a page of parity is lost


def header(page: int) -> Header:
    return Header(1, VOLUME.id, page, VOLUME.file_bytes)


def read(index: int, page: int) -> DataPage:
    found = PageBytes(header(page), bytes(10), FileFacts(3, 1, 0), None, 0.0, 0, 0, 0, 0.0)
    return DataPage(index, found, model_version="m")


def test_a_lost_parity_page_is_not_missed_where_all_data_was_read() -> None:
    unread = Unread()
    groups = [unread.group_of(read(index, index)) for index in range(3)]
    unread.add(3, header(3), "m")
    assert groups[2] is not None
    assert list(unread.restored(groups[2])) == []
    assert unread.pages == {}
    assert unread.groups == {}


def test_a_group_that_lacks_too_much_stays_and_takes_what_is_read_again() -> None:
    unread = Unread()
    group = unread.group_of(read(2, 2))
    for index in (0, 1, 3):
        unread.add(index, header(index), "m")
    assert group is not None
    assert list(unread.restored(group)) == []
    assert sorted(unread.pages) == [0, 1, 3]
    again = unread.group_of(read(1, 1))
    assert again is not None
    assert sorted(again.pages) == [1, 2]


def test_a_page_that_was_read_says_which_ones_were_lost_before_it_and_a_lost_one_of_no_header_nothing() -> None:
    unread = Unread()
    for index in (0, 1, 2):
        unread.add(index, None, "m")
    unread.told(4, header(3))
    assert unread.pages == {0: None, 1: header(0), 2: header(1)}
    assert unread.group_of(DataPage(5, PageBytes(None, None, None, Loss.HEADER, 0.0, 0, 0, 0, 0.0))) is None


def plane_of(decoder: Decoder) -> DataPlane:
    return DataPlane(Models(decoder), toy.ToySource(toy.ToyDevice()))


@pytest.mark.parametrize("full", [False, True], ids=["no code", "no slot"])
def test_without_a_code_or_a_slot_no_page_is_read_again(full: bool, decoder: Decoder) -> None:
    plane, unread = plane_of(decoder), Unread()
    unread.add(0, None, "toy-1")
    for _ in range(full * plane.decodes.count):
        plane.decodes.take(Caller())
    assert [*read_again(plane, unread, Caller(lambda: 0.0 if full else 60.0))] == []
    assert [*unread.pages] == [0]


@pytest.mark.parametrize("full", [False, True], ids=["no time", "no slot"])
def test_a_range_ends_after_its_first_look_where_healing_leaves_no_room_for_a_second(
    full: bool, decoder: Decoder
) -> None:
    manifest = decoder.bundle.manifest.model_copy(update={"code": CODE.to_toml()})
    plane, left_s = plane_of(Decoder(replace(decoder.bundle, manifest=manifest), threads=1)), [60.0]
    asked = []

    def heal(caller: Caller, version: str, lost: int) -> bool:
        asked.append((version, lost))
        left_s[0] = 0.0
        for _ in range(full * plane.ranges.count):
            plane.ranges.take(caller)
        return True

    plane.heal = heal
    with ThreadPoolExecutor(1) as pool:
        call = Call("ReadData", Caller(lambda: left_s[0]), pool)
        replies = [*PageCalls(plane).ReadData(pb.ReadDataRequest(first_page=0, pages=2), call)]
    assert [reply.page for reply in replies] == [0, 1]
    assert asked == [("toy-1", 2)]


def test_user_bytes_are_not_asked_of_pages_with_other_levels_than_those_of_the_code(decoder: Decoder) -> None:
    code = CODE.model_copy(update={"levels": 64})
    other = replace(decoder.bundle, manifest=decoder.bundle.manifest.model_copy(update={"code": code.to_toml()}))
    with pytest.raises(SourceError, match="levels"):
        read_page(plane_of(Decoder(other, threads=1)), 0, None, Caller(), user_data=True)
