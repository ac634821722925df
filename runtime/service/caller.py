"""What the data plane needs to know of whoever called: how long they wait, and whether they are still there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from runtime.errors import CallerLeft


@dataclass(frozen=True)
class Caller:
    """Whoever waits for an answer. The default waits for ever and never leaves.

    Attributes:
        seconds_left: how long the caller still waits, infinite without a deadline.
        is_here: False once the caller has gone.
    """

    seconds_left: Callable[[], float] = lambda: math.inf
    is_here: Callable[[], bool] = lambda: True

    def check(self) -> None:
        """Raise `CallerLeft` if the caller has gone."""
        if not self.is_here():
            raise CallerLeft
