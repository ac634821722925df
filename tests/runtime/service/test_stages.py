"""The stages of a page are the whole of its way, whatever happens on it."""

from __future__ import annotations

from itertools import pairwise

from runtime.service.stages import CallTimes, Lap, Stage, Stages
from tests.clock import HandClock


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
    for one, following in pairwise(stages.laps):
        assert one.end == following.start


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
    assert stages.laps == (Lap(Stage.INFERENCE, 100.0, 101.0), Lap(Stage.POST_PROCESSING, 101.0, 103.0))


def test_what_has_ended_changes_no_more() -> None:
    clock = HandClock(100.0)
    stages = Stages(clock=clock.now)
    stages.begin(Stage.QUEUE)
    clock.advance(1.0)
    stages.end()
    clock.advance(1.0)
    stages.begin(Stage.RESPOND)
    stages.end()
    assert stages.seconds() == {Stage.QUEUE: 1.0}
    assert stages.elapsed_s == 1.0


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
    assert times.pages == (first,)
