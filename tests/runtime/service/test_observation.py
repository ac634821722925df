"""Observers are told of every page, given out or lost, and cost nobody a page."""

from __future__ import annotations

import numpy as np
import pytest

from lightpage.errors import FrameError
from lightpage.page.pilots import Pilots
from lightpage.von_mises import information
from runtime.acquisition.source import SHOT_S, Shot
from runtime.decoding.decoder import Decoder
from runtime.errors import LostShotError, Reason, SourceError, UnconfirmedPageError
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane
from runtime.service.monitor import PageFigures
from runtime.service.observation import Observation, Seen
from runtime.service.registry import ModelRegistry
from tests.clock import HandClock
from tests.runtime import toy


class Notebook:
    def __init__(self, *, broken: bool = False) -> None:
        self.seen: list[Observation] = []
        self.broken = broken

    def observe(self, observation: Observation) -> None:
        self.seen.append(observation)
        if self.broken:
            raise RuntimeError("no more paper")


class LosingSource(toy.ToySource):
    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        if page == 1:
            raise LostShotError("page 1 of toy:device", "no frame", "two frames", Reason.MISSING_FRAME)
        return super().shot(timeout_s, page)


def test_pages_given_out_and_lost_are_observed(decoder: Decoder) -> None:
    broken, notebook = Notebook(broken=True), Notebook()
    registry = ModelRegistry(decoder)
    plane = DataPlane(registry, LosingSource(toy.ToyDevice()), observers=[broken, notebook])
    plane.read_page(0, None, Caller())
    with pytest.raises(LostShotError):
        plane.read_page(1, None, Caller())
    pair = toy.ToyDevice().page(toy.symbols_of(16, 3)[0], 16, 0.1)
    wrong = Pilots.of_symbols(registry.current.decoder.bundle.pilot_mask, np.zeros(toy.PAGE, np.uint8), 16)
    with pytest.raises(UnconfirmedPageError):
        plane.decode(pair, 16, Caller(), wrong)
    given, shot, unconfirmed = notebook.seen
    assert (given.page_index, given.lost, given.tells) == (0, None, True)
    assert given.page is not None
    assert given.pair is not None
    kappa = given.page.concentration.astype(np.float64)
    assert given.claimed_bits == pytest.approx(information(kappa).mean() / np.log(2))
    air, residual = given.claimed_bits, given.residual_rad
    assert air is not None
    assert 0 < air <= 8
    assert residual is not None
    assert not given.unread
    assert (shot.page_index, shot.lost, shot.pair, shot.page) == (1, Reason.MISSING_FRAME, None, None)
    assert shot.unread
    assert unconfirmed.lost is Reason.PILOTS_DISAGREE
    assert unconfirmed.page is not None
    assert not unconfirmed.tells
    assert len(broken.seen) == 3
    lost = plane.metrics.registry.get_sample_value("lightpage_pages_lost_total", {"reason": "MISSING_FRAME"})
    assert lost == 1


def test_pages_of_the_source_whose_frames_contradict_each_other_are_observed_as_lost(decoder: Decoder) -> None:
    notebook, source = Notebook(), toy.ToySource(toy.ToyDevice((180.0, 30.0)))
    plane = DataPlane(ModelRegistry(decoder), source, observers=[notebook])
    with pytest.raises(SourceError, match="contradict"):
        plane.read_page(0, None, Caller())
    with pytest.raises(FrameError, match="contradict"):  # a caller's frames may be swapped
        plane.decode(source.shot(page=1).pair, 16, Caller())
    (seen,) = notebook.seen
    assert (seen.lost, seen.page_index, seen.page) == (Reason.UNSPECIFIED, 0, None)
    assert seen.pair is not None
    assert "contradict" in seen.detail
    assert PageFigures().of(seen) == {"unread": 1}


def test_a_page_is_timed_from_its_begin_to_its_end() -> None:
    since_1970, lap = HandClock(1e9), HandClock(5.0)
    seen = Seen("page 3", 3, "toy-1", since_1970.now, lap.now)
    since_1970.advance(7.0)
    lap.advance(0.25)
    seen.note(subject="page 4", levels=16)
    ended = seen.ended(Reason.MISSING_FRAME, "dark")
    assert ended == Observation("page 4", 3, "toy-1", 1e9 + 7.0, 0.25, Reason.MISSING_FRAME, "dark", levels=16)
