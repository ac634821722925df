"""Levels of a page: how many a symbol may have, which is stored in one byte, and the phase that stands for each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lightpage.errors import PageError

MIN_LEVELS = 2
MAX_LEVELS = 256

Real = NDArray[np.float64]

_STEPS = 4096
"""Steps in a turn, to find the nearest of uneven levels by: a sixteenth of the distance of 256 levels."""


def check_levels(levels: int, subject: str = "levels") -> None:
    """Check a level count.

    Raises:
        PageError: not a whole number from 2 to 256.
    """
    whole = isinstance(levels, (int, np.integer)) and not isinstance(levels, bool)
    if not whole or not MIN_LEVELS <= levels <= MAX_LEVELS:
        raise PageError(subject, repr(levels), f"a whole number from {MIN_LEVELS} to {MAX_LEVELS}")


@dataclass(frozen=True)
class Levels:
    """Levels of a page, and the phase that stands for each.

    Attributes:
        count: M.
        uneven: phase of each level, radians, any winding; None where level s is the phase 2 pi s / M. Two levels may
            have the same phase, as where a modulator's stroke is more than 2 pi.
        crosstalk: shares of its neighbours' phases, along x and y, that the modulator adds to a symbol's.

    Raises:
        PageError: a count outside 2..256, another number of phases, or one that is not finite.
    """

    count: int
    uneven: tuple[float, ...] | None = None
    crosstalk: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Check count and phases."""
        check_levels(self.count)
        if self.uneven is not None and not (len(self.uneven) == self.count and np.isfinite(self.uneven).all()):
            raise PageError("phases of levels", f"{len(self.uneven)} phases", f"{self.count} finite ones")

    @classmethod
    def of(cls, levels: int | Levels) -> Levels:
        """Levels themselves, or so many even ones."""
        return levels if isinstance(levels, Levels) else cls(levels)

    @property
    def is_nominal(self) -> bool:
        """Return whether the levels are even: level s has the phase 2 pi s / M."""
        return self.uneven is None

    @property
    def carry_bits(self) -> bool:
        """Return whether levels carry whole bits: M is a power of two."""
        return self.count & (self.count - 1) == 0

    @cached_property
    def phases(self) -> Real:
        """Phase of each level, radians, [M]."""
        if self.uneven is None:
            return np.asarray(np.arange(self.count) * (2 * np.pi / self.count), np.float64)
        return np.array(self.uneven, np.float64)

    def every(self, step: int, first: int = 0) -> Self:
        """Every so manieth of these levels, from level `first` on; at least two must be left."""
        if self.uneven is None and first == 0:
            return type(self)(self.count // step)
        return type(self)(self.count // step, tuple(self.phases[first::step].tolist()))

    def nearest(self, mu: ArrayLike) -> NDArray[np.uint8]:
        """The level nearest to each phase (radians, any winding); same shape."""
        phase = np.asarray(mu, np.float64)
        if self.uneven is None:
            nearest = np.rint(phase * (self.count / (2 * np.pi)))
            return np.asarray(nearest.astype(np.int64) % self.count, np.uint8)
        return np.asarray(self.order[self.places(phase)], np.uint8)

    def nearest_phases(self, mu: Real) -> Real:
        """Phase of the level nearest to each phase, radians, within pi of it; same shape."""
        return self.around(mu)[1]

    def around(self, mu: Real) -> tuple[NDArray[np.intp] | tuple[()], Real]:
        """Place on the circle and phase of the level nearest to each phase, radians, within pi of it; same shape.

        Every place is like any other, and left out, where levels are even.
        """
        if self.uneven is None:
            step = 2 * np.pi / self.count
            return (), np.asarray(np.rint(mu / step) * step)
        places = self.places(mu)
        phases = self.circle[places]
        return places, np.asarray(phases + 2 * np.pi * np.rint((mu - phases) / (2 * np.pi)))

    def half_way(self, mu: Real) -> Real | float:
        """Half the distance from each phase's nearest level to the next one, radians; of even levels one number."""
        if self.uneven is None:
            return np.pi / self.count
        return np.asarray(np.abs(self.gaps(np.array([-1, 1]))).min(axis=0)[self.places(mu)] / 2)

    @cached_property
    def order(self) -> NDArray[np.intp]:
        """Levels in the order in which they lie on the circle, [M]."""
        return np.argsort(np.mod(self.phases, 2 * np.pi), kind="stable")

    @cached_property
    def circle(self) -> Real:
        """Phases in the order in which they lie on the circle, 0 to 2 pi, [M]."""
        return np.asarray(np.mod(self.phases, 2 * np.pi)[self.order])

    def places(self, mu: Real) -> NDArray[np.intp]:
        """Place on the circle of the level nearest to each phase (radians, any winding); same shape."""
        first, borders, starts, most = self.borders
        turns = (mu - first) / (2 * np.pi)
        turns = turns - np.floor(turns)
        found = starts[(turns * (len(starts) - 1)).astype(np.intp)]
        for _ in range(most):  # a search by halves in a long table takes several times as long
            found = found + (turns > borders[found])
        return np.asarray(found)

    @cached_property
    def borders(self) -> tuple[float, Real, NDArray[np.intp], int]:
        """Half ways between levels on the circle.

        Returns:
            That between the last level and the first, radians; how far from there the one behind each level is, turns,
            [M]; how many lie before each of many equal steps of a turn; the most that lie within one.
        """
        ways = self.circle + self.gaps(np.array([1]))[0] / 2
        first = float(ways[-1]) - 2 * np.pi
        borders = (ways - first) / (2 * np.pi)
        starts = np.searchsorted(borders[:-1], np.arange(_STEPS + 1) / _STEPS)
        borders[-1] = np.inf
        return first, borders, starts, int(np.diff(starts, append=self.count - 1).max())

    def gaps(self, neighbours: NDArray[np.integer]) -> Real:
        """Return angles from the level at each place on the circle to some of its neighbours, radians, [neighbours, M].

        Args:
            neighbours: how many places further on each is, [neighbours].
        """
        wanted = np.arange(self.count) + neighbours[:, None]
        turns, places = np.divmod(wanted, self.count)
        return np.asarray(self.circle[places] + 2 * np.pi * turns - self.circle)
