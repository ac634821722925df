"""Modulation: the complex light that a modulator makes of a page, by a few coefficients.

Nominally level s of M is light of unit amplitude and the phase 2 pi s / M. A real modulator has a phase stroke of less
or more than 2 pi, a lookup table that is not straight, light that it does not modulate, and an amplitude that goes with
the phase. The logarithm of what it makes, over what it should make, is a straight line and a short Fourier series.
Crosstalk adds to a symbol's phase a share of those of the symbols beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from lightpage.page.crosstalk import of_neighbours
from lightpage.page.levels import Levels
from lightpage.page.symbols import symbol_phases

Real = NDArray[np.float64]

HARMONICS = 3
"""Order of the Fourier series: a fifth of unmodulated light leaves an error of 4e-4."""
_SERIES = tuple(f"{function}_{number}" for number in range(1, HARMONICS + 1) for function in ("cos", "sin"))
CROSSTALK = ("crosstalk_x_relative", "crosstalk_y_relative")
NAMES = (
    "stroke_relative",
    *(f"phase_{name}_rad" for name in _SERIES),
    *(f"amplitude_{name}_log" for name in _SERIES),
    *CROSSTALK,
)
"""Names of the coefficients, each zero nominally."""
PRIORS: Real = np.array([0.02, *[0.2 / number for number in range(1, HARMONICS + 1) for _ in "cs"] * 2, 0.02, 0.02])
"""Standard deviations of the coefficients about nominal, before data are seen."""
DRIFTS: Real = PRIORS * [1.0, *[0.1] * (len(NAMES) - 1)]
"""Standard deviations of the coefficients about those of an earlier day: a stroke changes with temperature, a lookup
table hardly."""


def basis(phases: Real) -> Real:
    """Functions of nominal phases [...] that the coefficients multiply, [1 + 2 HARMONICS, ...]."""
    turns = [function(number * phases) for number in range(1, HARMONICS + 1) for function in (np.cos, np.sin)]
    return np.stack([phases - np.pi, *turns])


def page_basis(phases: Real) -> Real:
    """The functions of `basis`, and those of crosstalk, of a page's nominal phases, [3 + 2 HARMONICS, ny, nx]."""
    return np.concatenate([basis(phases), [of_neighbours(phases, (1, 0)), of_neighbours(phases, (0, 1))]])


@dataclass(frozen=True)
class Modulation:
    """The light that a modulator makes of its levels, and of a page of them.

    Attributes:
        coefficients: coefficients in the order of `NAMES`.
    """

    coefficients: tuple[float, ...] = (0.0,) * len(NAMES)

    @cached_property
    def is_nominal(self) -> bool:
        """Return whether every coefficient is zero."""
        return not any(self.coefficients)

    def light(self, phases: Real) -> NDArray[np.complex128]:
        """Complex light of nominal phases, in their shape."""
        if self.is_nominal:
            return np.asarray(np.exp(1j * phases), np.complex128)
        phases = np.mod(phases, 2 * np.pi)
        found, phase = basis(phases), np.array(self.coefficients[: 1 + 2 * HARMONICS])
        amplitude = np.array(self.coefficients[len(phase) : -len(CROSSTALK)])
        logarithm = 1j * (phases + np.tensordot(phase, found, 1)) + np.tensordot(amplitude, found[1:], 1)
        return np.asarray(np.exp(logarithm), np.complex128)

    def phase(self, phases: Real) -> Real:
        """Phase of the light of nominal phases, radians, in their shape: near each, and exactly it nominally."""
        if self.is_nominal:
            return phases
        return np.asarray(phases + np.angle(self.light(phases) * np.exp(-1j * phases)))

    @property
    def crosstalk(self) -> tuple[float, float]:
        """Shares of the phases of the neighbours along x, and along y, that add to a symbol's phase."""
        return self.coefficients[-2], self.coefficients[-1]

    def page_light(self, phases: Real) -> NDArray[np.complex128]:
        """Complex light of a page of nominal phases [ny, nx], in their shape."""
        return np.asarray(self.light(phases) * np.exp(1j * of_neighbours(phases, self.crosstalk)))

    def phases(self, count: int) -> Real:
        """Phase of each of so many levels' light, radians, unwrapped, [M]; exactly 2 pi s / M nominally."""
        return self.phase(symbol_phases(np.arange(count), count))

    def page_levels(self, count: int) -> Levels:
        """Return so many levels of a page, as the phases of their light tell them apart.

        Raises:
            PageError: a level count outside 2..256.
        """
        return _page_levels(self, count)

    def as_dict(self) -> dict[str, float]:
        """Coefficients by name."""
        return dict(zip(NAMES, self.coefficients, strict=True))


@lru_cache(16)
def _page_levels(modulation: Modulation, count: int) -> Levels:
    """Return the levels of a modulation, cached: all pages of a device share them and what they have computed."""
    even = not any(modulation.coefficients[: -len(CROSSTALK)])
    return Levels(count, None if even else tuple(modulation.phases(count).tolist()), modulation.crosstalk)


NOMINAL = Modulation()
"""Level s of M is the phase 2 pi s / M."""
