"""Measures by how much the walls of a pipe stand further apart along y' than along x'.

No parameter of the fit says so, since the graphs of a bundle have none for it. The waves of a known page are fitted
anew for several distances instead, and the distance that leaves the least is taken (profile likelihood).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from lightpage.calibration.goodness.light import PageLight
from lightpage.calibration.parameters import GROUPS
from lightpage.calibration.waves.wave_fit import WaveFit

_FIRST_STEP = 5e-4
"""First change of the height over the width that is tried."""
_MOST_STEPS = 6
"""Steps, at most, until the residual grows again on either side."""
_SPACING = 2e-4
"""Distance of the values from which the last parabola is made: the residual is one there."""


class WallDifference(NamedTuple):
    """Height of a pipe over its width, minus 1.

    Attributes:
        relative: value.
        deviation: its standard deviation.
        width_m: width of the pipe, metres.
    """

    relative: float
    deviation: float
    width_m: float

    def __str__(self) -> str:
        """Difference of height and width in words."""
        width_um = 1e6 * self.width_m
        return f" (height minus width: {width_um * self.relative:+.3f} +- {width_um * self.deviation:.3f} um)"


def wall_difference(light: PageLight) -> WallDifference | None:
    """Measure the difference of height and width of the pipe by the light of a known page.

    None where the residual shows none.
    """
    device = light.device
    squares: dict[float, float] = {}
    best = device.parameters, device.quadrature_phase_rad

    def residual(difference: float) -> float:
        """Mean square of what the waves of a pipe with this difference leave."""
        nonlocal best
        changed = {"pipe_height_relative": difference}
        fit = WaveFit(light.twin, device.profile, light.pair, device.references, light.symbols, changed)
        fitted = fit.fit(*best, GROUPS, modulation=device.modulation, effort="once")
        if not squares or fitted.residual**2 < min(squares.values()):
            best = fitted.parameters, fitted.quadrature_phase
        squares[difference] = fitted.residual**2
        return squares[difference]

    try:
        bracket = scipy.optimize.bracket(residual, 0.0, _FIRST_STEP, maxiter=_MOST_STEPS)[:3]
    except RuntimeError:  # no least residual within so many steps
        return None
    middle = _vertex(bracket, squares)[0]
    near = [middle - _SPACING, middle, middle + _SPACING]
    for difference in near:
        residual(difference)
    value, curvature = _vertex(near, squares)
    if not curvature > 0:
        return None
    # what is unexplained differs from symbol to symbol, so equations tell no more than symbols do
    deviation = np.sqrt(min(squares.values()) / (2 * light.symbols.size * curvature))
    return WallDifference(value, float(deviation), device.profile.pipe.width_m)


def _vertex(places: Sequence[float], values: Mapping[float, float]) -> tuple[float, float]:
    """Vertex and curvature of the parabola through the values at three places."""
    curvature, slope, _ = np.polyfit(places, [values[place] for place in places], 2)
    return float(-slope / (2 * curvature)), float(curvature)
