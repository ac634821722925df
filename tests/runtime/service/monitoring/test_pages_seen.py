"""What is known of a page: observers are told of each and cost nobody one; figures; the stages of its whole way."""

from itertools import pairwise
from unittest.mock import Mock

import numpy as np
import pytest

from lightpage.errors import FrameError, LostShotError, Reason, SourceError, UnconfirmedPageError
from lightpage.page.pilots import Pilots
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane, Seen
from lightpage.runtime.service.frames.frames import decode
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.metrics import VERSIONS, ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import PageFigures
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.pages.reading import read_page
from lightpage.runtime.service.stages import CallTimes, Lap, Stage, Stages
from lightpage.von_mises import information
from tests.clock import HandClock
from tests.runtime import toy


def test_pages_given_out_and_lost_are_observed(decoder: Decoder) -> None:
    broken, notebook, registry = Mock(), Mock(), Models(decoder)
    broken.observe.side_effect = RuntimeError("no more paper")
    plane = DataPlane(registry, source := toy.ToySource(toy.ToyDevice()), observers=[broken, notebook])
    read_page(plane, 0, None, Caller())
    lost = LostShotError("page 1 of toy:device", "no frame", "two frames", Reason.MISSING_FRAME)
    source.shot = Mock(side_effect=lost)  # type: ignore[method-assign]
    with pytest.raises(LostShotError):
        read_page(plane, 1, None, Caller())
    pair = toy.ToyDevice().page(toy.symbols_of(16, 3)[0], 16, 0.1)
    wrong = Pilots.of_symbols(registry.current.decoder.bundle.pilot_mask, np.zeros(toy.PAGE, np.uint8), 16)
    with pytest.raises(UnconfirmedPageError):
        decode(plane, pair, 16, Caller(), wrong)
    given, shot, unconfirmed = (call.args[0] for call in notebook.observe.call_args_list)
    assert (given.page_index, given.lost, given.tells) == (0, None, True)
    assert given.pair is not None
    kappa = given.page.concentration.astype(np.float64)
    assert given.page.information_bits == pytest.approx(information(kappa).mean() / np.log(2))
    assert given.page.residual_rad == pytest.approx(np.sqrt(np.square(given.page.phase_error).mean()))
    assert (shot.page_index, shot.lost, shot.pair, shot.page) == (1, Reason.MISSING_FRAME, None, None)
    assert (unconfirmed.lost, unconfirmed.tells) == (Reason.PILOTS_DISAGREE, False)
    assert unconfirmed.page is not None
    assert broken.observe.call_count == 3
    counted = plane.metrics.registry.get_sample_value("lightpage_pages_lost_total", {"reason": "MISSING_FRAME"})
    assert counted == 1


def test_pages_of_the_source_whose_frames_contradict_each_other_are_observed_as_lost(decoder: Decoder) -> None:
    notebook, source = Mock(), toy.ToySource(toy.ToyDevice((180.0, 30.0)))
    plane = DataPlane(Models(decoder), source, observers=[notebook])
    with pytest.raises(SourceError, match="contradict"):
        read_page(plane, 0, None, Caller())
    with pytest.raises(FrameError, match="contradict"):  # a caller's frames may be swapped
        decode(plane, source.shot(page=1).pair, 16, Caller())
    (seen,) = notebook.observe.call_args.args
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


def test_pages_are_told_apart_by_the_newest_models_only(decoder: Decoder) -> None:
    metrics, page = ServiceMetrics(), decoder.decode(toy.ToyDevice().page(toy.symbols_of(16, 1)[0], 16, 0.5), 16)
    for number in range(3 * VERSIONS):
        metrics.in_service(f"toy-{number}")
        metrics.pages.labels(f"toy-{number}").inc()
        metrics.in_service("toy-0")
    metrics.page(page, "toy-1")  # it was decoded while its model was removed
    told = {sample.labels["model_version"] for family in metrics.pages.collect() for sample in family.samples}
    assert len(told) <= VERSIONS
    assert {"toy-0", f"toy-{3 * VERSIONS - 1}"} <= told


def test_the_stages_are_the_whole_way() -> None:
    clock = HandClock(100.0)
    stages = Stages(clock=clock.now)
    clock.advance(0.25)
    for stage, seconds in ((Stage.RECEIVE, 1.0), (Stage.QUEUE, 2.0), (Stage.INFERENCE, 4.0)):
        stages.begin(stage)
        clock.advance(seconds)
    stages.begin(Stage.POST_PROCESSING, after_s=3.0)
    for stage, seconds in ((None, 8.0), (Stage.CODE, 16.0), (Stage.RESPOND, 32.0)):
        if stage is not None:
            stages.begin(stage)
        clock.advance(seconds)
    assert stages.seconds()[Stage.RESPOND] == 32.0
    stages.end()
    assert stages.seconds() == {
        Stage.RECEIVE: 1.25,
        Stage.QUEUE: 2.0,
        Stage.INFERENCE: 3.0,
        Stage.POST_PROCESSING: 9.0,
        Stage.CODE: 16.0,
        Stage.RESPOND: 32.0,
    }
    assert sum(stages.seconds().values()) == stages.elapsed_s == 63.25
    assert all(one.end == following.start for one, following in pairwise(stages.laps))


def test_a_stage_is_never_longer_than_the_time_that_has_passed() -> None:
    clock = HandClock(100.0)
    stages = Stages(clock=clock.now)
    stages.begin(Stage.INFERENCE)
    clock.advance(1.0)
    stages.begin(Stage.POST_PROCESSING, after_s=5.0)
    clock.advance(1.0)
    stages.begin(Stage.POST_PROCESSING)
    clock.advance(1.0)
    stages.end()
    clock.advance(1.0)
    stages.begin(Stage.RESPOND)  # too late
    stages.end()
    assert stages.elapsed_s == 3.0
    assert stages.laps == [Lap(Stage.INFERENCE, 100.0, 101.0), Lap(Stage.POST_PROCESSING, 101.0, 103.0)]


def test_the_pages_of_a_call_follow_each_other_and_end_with_it() -> None:
    seen: list[Stages] = []
    times = CallTimes(10.0, seen.append, keep=1)
    first = times.page()
    first.begin(Stage.QUEUE)
    times.done(first, 12.0)
    second = times.page()
    second.begin(Stage.QUEUE)
    third = times.page(13.0)
    third.begin(Stage.RECEIVE)
    times.end(15.0)
    times.end(20.0)
    assert [page.seconds() for page in seen] == [{Stage.QUEUE: 2.0}, {Stage.QUEUE: 3.0}, {Stage.RECEIVE: 2.0}]
    assert times.count == 3
    assert times.pages == [first]
