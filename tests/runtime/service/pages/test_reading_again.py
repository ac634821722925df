"""Pages that came to nothing get a second look where there is room, time and a code for it; else all ends well."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest

from lightpage.codec.code import Code
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Call, Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.pages.page_calls import PageCalls
from lightpage.runtime.service.pages.reading import Unread, read_again
from tests.runtime import toy

CODE = Code(levels=256, coded_bits=2, rate_per_mille=500)


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
