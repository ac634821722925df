"""Pages of a recording that are decoded ahead: the same in the end as one by one, and by the model in use."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.decoding_ahead import Shown, Symbols, decoded_ahead
from lightpage.runtime.archives.recordings.evaluation import evaluate
from lightpage.runtime.archives.recordings.recovery import recover
from lightpage.runtime.model.decoding.batches import Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.model.decoding.turns import Turn, Turns
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.frames.frames import decode
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from tests.runtime import coded, toy
from tests.runtime.held_graph import LARGEST, HeldGraph


@dataclass
class Follower:
    """A tracker that is asked for turns alone, and a recording of pages without frames."""

    turns: Turns = field(default_factory=Turns)
    seen: list[int] = field(default_factory=list)

    def turn(self) -> Turn:
        return self.turns.take()

    def shown(self, page: int) -> tuple[FramePair, Symbols]:
        return FramePair(np.full(1, page), np.zeros(1)), None


def test_pages_that_the_model_before_has_decoded_are_decoded_again_in_their_order() -> None:
    def decode(page: Shown, frames: FramePair, symbols: Symbols) -> int:
        with page.turn:
            cast(Follower, page.tracker).seen.append(number := int(frames.in_phase[0]))
            return number

    models, found = cast(Any, [Follower() for _ in range(3)]), list[int]()
    for _, result in decoded_ahead(models[2], range(16), lambda: models[len(found) >= 3], 2, decode):
        found.append(result()[0])
    assert found == list(range(16))
    assert models[1].seen == found[3:]


class Late(NoTracker):
    """Says of every page that it has waited behind others for a day."""

    def decode(self, *asked: Any) -> DecodedPage:
        page = super().decode(*asked)
        return replace(page, timings=replace(page.timings, turn_s=86400.0))


def test_the_time_of_a_page_is_told_and_learnt_without_that_in_which_it_waited_for_others(tmp_path: Path) -> None:
    bundle = coded.bundle(tmp_path / "coded.zip")
    symbols, decoder = coded.pages(bundle, tmp_path), Decoder.load(bundle, threads=1)
    with Recording.open(coded.recording(tmp_path / "R.h5", symbols, {})) as recording:
        read = recover(decoder, recording, Late(decoder), coded.CODE, tmp_path / "read.bin", heals=False)
        told = evaluate(decoder, recording, Late(decoder)).seconds_per_page
    assert 0 < told < 3600
    assert max(page.seconds for page in read.pages) < -3600  # for it has not really waited
    plane = DataPlane(Models(decoder, loader=Loader(Late)))
    decode(plane, toy.ToyDevice().page(symbols[0], coded.CODE.levels), None, Caller())
    assert plane.decodes.usual_s < -3600


def test_a_file_is_recovered_in_batches_as_page_by_page(tmp_path: Path) -> None:
    bundle = coded.bundle(tmp_path / "coded.zip")
    symbols = coded.pages(bundle, tmp_path)
    path = coded.recording(tmp_path / "R.h5", symbols, {1: coded.half_lost, 4: coded.dark})
    decoder = Decoder.load(bundle, threads=1)
    graph, batching = HeldGraph(decoder), Batching(LARGEST)
    graph.run_together(batching)
    results = []
    for each in (decoder, graph.gathering(batching)):
        with Recording.open(path) as recording:
            read = recover(each, recording, NoTracker(each), coded.CODE, tmp_path / "read.bin", heals=False)
        assert (tmp_path / "read.bin").read_bytes() == coded.CONTENT
        pages = tuple(replace(page, seconds=0.0, code_seconds=0.0) for page in read.pages)
        results.append(replace(read, pages=pages).to_json())
    assert results[0] == results[1]
    assert results[0]["pages_unread"] == 2
    assert max(batching.pages.runs) > 1
