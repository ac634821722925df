"""Figures of measured seconds: medians, spreads, and whether servers differ by more than the spread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Figure:
    """A median with the spread of the run around it.

    Attributes:
        p10, p50, p90: quantiles, in the unit of the values.
    """

    p10: float
    p50: float
    p90: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Figure:
        """Summarise values, of which there is at least one."""
        p10, p50, p90 = (float(each) for each in np.quantile(values, [0.1, 0.5, 0.9]))
        return cls(p10, p50, p90)

    @property
    def spread(self) -> float:
        """Difference of p90 and p10."""
        return self.p90 - self.p10


@dataclass(frozen=True)
class Comparison:
    """The service beside another server.

    Attributes:
        difference: difference of the medians, positive where the service is better.
        spread: the larger one of both.
    """

    difference: float
    spread: float

    @classmethod
    def of(cls, own: Figure, other: Figure, more_is_better: bool = False) -> Comparison:
        """Compare two servers by seconds, or by rates if more is better."""
        difference = own.p50 - other.p50 if more_is_better else other.p50 - own.p50
        return cls(difference, max(own.spread, other.spread))

    @property
    def missed_by(self) -> float:
        """Amount by which the difference falls short of the spread; zero or less where it does not."""
        return self.spread - self.difference
