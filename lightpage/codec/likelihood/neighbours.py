"""Tables of levels around the nearest one, from which the weights of a phase's levels follow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import factorial, inf

import numpy as np
from numpy.typing import NDArray

from lightpage.page.levels import Levels

Real = NDArray[np.float64]

NEAR = 16
"""Levels around the nearest one that mostly suffice."""
_NOTHING = 60.0
"""Weights below e^-60 of the nearest level's change no LLR, which ends at 40."""
_ROUNDING = 2.0**-58
"""Share of the last term of a series that is left out."""


@dataclass(frozen=True)
class Neighbours:
    """Levels around each place on the circle, from half of them before it on.

    Attributes:
        cosine: cosines of the ways to them, less 1, [rows, width]; one row for all places where levels are even.
        sine: sines of the ways, the same shape.
        coset: number of their cosets, [levels, width]; none where cosets follow each other.
    """

    cosine: Real
    sine: Real
    coset: NDArray[np.uint8]

    @property
    def width(self) -> int:
        """Number of neighbours of a place."""
        return int(self.cosine.shape[1])

    @property
    def packed(self) -> tuple[int, Real, Real, NDArray[np.uint8]]:
        """Fields in the order that the compiled code takes."""
        return self.width, self.cosine, self.sine, self.coset


class LevelTable:
    """Table of levels, neighbours and cosets that the LLRs of a page's label bits are computed from.

    Args:
        levels: levels of the page, a power of two.
        bits: b.
    """

    def __init__(self, levels: Levels, bits: int) -> None:
        self.levels, self.bits, self.cosets = levels, bits, 1 << bits
        self.all = self._around(levels.count)
        self.near = self._around(min(NEAR, levels.count))

    @cached_property
    def turn(self) -> int | None:
        """Level at the first place where levels follow each other on the circle, as even ones do; None elsewhere."""
        if self.levels.is_nominal:
            return 0
        first, count = int(self.levels.order[0]), self.levels.count
        return first if np.array_equal(self.levels.order, (first + np.arange(count)) % count) else None

    def _ways(self, numbers: NDArray[np.int64]) -> Real:
        """Return the angles from each place to its neighbours, radians, [rows, neighbours]; one row for even levels."""
        if self.levels.is_nominal:
            return np.asarray(numbers * (2 * np.pi / self.levels.count))[None]
        return np.ascontiguousarray(self.levels.gaps(numbers).T)

    def _around(self, width: int) -> Neighbours:
        numbers = np.arange(width) - width // 2
        ways = self._ways(numbers)
        coset = np.zeros((0, width), np.int64)
        if self.turn is None:
            coset = (
                self.levels.order[(np.arange(self.levels.count)[:, None] + numbers) % self.levels.count] % self.cosets
            )
        return Neighbours(-2 * np.sin(ways / 2) ** 2, np.sin(ways), np.ascontiguousarray(coset, np.uint8))

    @cached_property
    def limit(self) -> Real:
        """Concentration from which the near neighbours of a place suffice, [rows]."""
        if self.near.width == self.levels.count:
            return np.zeros(len(self.all.cosine))
        farthest = self._farthest
        dropped = np.abs(self._ways(np.array([-NEAR // 2 - 1, NEAR // 2]))).min(axis=1)
        difference = np.cos(farthest) - np.cos(np.minimum(dropped - farthest, np.pi))
        return np.where(difference > 0, _NOTHING / np.where(difference > 0, difference, 1), inf)

    @property
    def _farthest(self) -> Real:
        """Way of a phase from its nearest level, at most, of each place, radians, [rows]."""
        return np.asarray(np.abs(self._ways(np.array([-1, 1]))).max(axis=1) / 2)

    @cached_property
    def series(self) -> tuple[Real, Real]:
        """Coefficients of the even powers of a way, of its sine over itself and of its cosine, [terms]."""
        most, terms = min(float(self._farthest.max()), np.pi), 2
        while most ** (2 * terms) / factorial(2 * terms) > _ROUNDING:
            terms += 1
        even = range(0, 2 * terms, 2)
        sine = [(-1) ** (k // 2) / factorial(k + 1) for k in even]
        return np.array(sine), np.array([(-1) ** (k // 2) / factorial(k) for k in even])

    @cached_property
    def packed(self) -> tuple[object, ...]:
        """Table in the form that the compiled code takes."""
        search: tuple[object, ...] = np.zeros(0), 0.0, np.zeros(0), np.zeros(0, np.int64), 0
        if not self.levels.is_nominal:
            first, borders, starts, most = self.levels.borders
            search = self.levels.circle, first, borders, np.ascontiguousarray(starts, np.int64), int(most)
        count, even, turn = self.levels.count, self.levels.is_nominal, -1 if self.turn is None else self.turn
        return count, self.bits, even, turn, *self.series, search, self.limit, self.near.packed, self.all.packed


@lru_cache(32)
def searches_of(levels: Levels, bits: int) -> tuple[object, ...]:
    """Return the search tables for the nearest uneven level of each coset, in the form that the compiled code takes.

    Args:
        levels: levels of the page, more than there are cosets.
        bits: b, of 2^b cosets.
    """
    cosets = [levels.every(1 << bits, coset) for coset in range(1 << bits)]
    first, borders, starts, most = zip(*(coset.borders for coset in cosets), strict=True)
    orders = np.array([coset.order for coset in cosets], np.uint8)
    return np.array(first), np.array(borders), np.array(starts, np.int64), int(max(most)), orders


@lru_cache(32)
def table_of(levels: Levels, bits: int) -> LevelTable:
    """The table of some levels and label bits, made once."""
    return LevelTable(levels, bits)
