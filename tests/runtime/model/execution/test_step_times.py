"""Times of steps, and the number of steps for which there is time."""

import math
from itertools import count

import pytest

from lightpage.runtime.model.execution.step_times import StepTimes


def measured(durations: dict[int, list[float]]) -> StepTimes:
    """Times with one early step, whose steps took so long, by their number."""
    now = 0.0
    times = StepTimes(1, lambda: now)
    for number, seconds in durations.items():
        for each in seconds:
            with times.measured(number):
                now += each
    return times


TIMES = measured({0: [1.0, 9.0, 1.0], 1: [0.5], 2: [2.0], 3: [2.0, 2.2]})


def test_times_are_medians_of_each_kind_of_step() -> None:
    assert [TIMES.seconds(steps) for steps in range(4)] == pytest.approx([1.0, 1.5, 3.5, 5.5])
    assert TIMES.step_s == pytest.approx(2.0)


def test_old_times_are_forgotten() -> None:
    assert measured({0: [100.0] * 20 + [1.0] * 9}).seconds(0) == 1.0


@pytest.mark.parametrize(
    ("left_s", "least", "most", "steps"),
    [
        (math.inf, 1, 3, 3),
        (6.2, 1, 3, 3),
        (5.6, 1, 3, 2),  # steps may take a little longer than usual
        (3.0, 1, 3, 1),
        (-1.0, 1, 3, 1),
        (3.0, 2, 3, 2),
        (0.0, 9, 3, 3),
    ],
)
def test_a_page_gets_the_steps_for_which_there_is_time(left_s: float, least: int, most: int, steps: int) -> None:
    assert TIMES.steps_within(left_s, least, most) == steps


def test_before_anything_was_measured_all_steps_are_taken() -> None:
    clock = count()
    assert StepTimes(1, lambda: next(clock)).steps_within(0.1, 1, 3) == 3


def test_a_step_that_fails_is_not_measured() -> None:
    times = measured({0: [1.0]})
    with pytest.raises(ZeroDivisionError), times.measured(0):
        _ = 1 / 0
    assert times.seconds(0) == 1.0
