"""A range of pages that are computed together gives what its pages give one by one."""

from pathlib import Path

from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.pages.reading import read_data
from lightpage.runtime.service.stages import CallTimes
from tests.runtime import coded
from tests.runtime.held_graph import LARGEST, HeldGraph


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
