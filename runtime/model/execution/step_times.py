"""Time of an estimator's steps as lately measured, and the number of steps for which a page has time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median

_REMEMBERED = 9
"""Measurements of each kind that count."""
_MARGIN = 1.1
"""Time that steps are expected to take at most, over their usual time."""


class StepTimes:
    """Lately measured times of a first estimate, of early steps and of later steps. For many threads.

    Args:
        early: number of early steps.
        clock: seconds that never go back.
    """

    def __init__(self, early: int, clock: Callable[[], float] = time.perf_counter) -> None:
        self._early = early
        self._clock = clock
        self._lately = tuple(deque[float](maxlen=_REMEMBERED) for _ in range(3))

    @contextmanager
    def measured(self, number: int) -> Iterator[None]:
        """Measure the time of step `number` within the `with` statement; 0 is the first estimate."""
        begun = self._clock()
        yield
        self._of(number).append(self._clock() - begun)

    def seconds(self, steps: int) -> float:
        """Usual time of a first estimate and so many steps, seconds; 0 for what was not measured yet."""
        usual = [median([*self._of(number)] or [0.0]) for number in range(steps + 1)]
        return float(sum(usual))

    @property
    def step_s(self) -> float:
        """Usual time of a later step, seconds; 0 where none was measured yet."""
        return float(median([*self._lately[2]] or [0.0]))

    def steps_within(self, left_s: float, least: int, most: int) -> int:
        """Number of steps for which `left_s` seconds are enough, from `least` to `most`; `most` where that is less."""
        steps = most
        while steps > least and _MARGIN * self.seconds(steps) > left_s:
            steps -= 1
        return steps

    def _of(self, number: int) -> deque[float]:
        return self._lately[0 if number == 0 else 1 if number <= self._early else 2]
