"""Correction of a decoded page by what its pilots and its levels show, from the network's answer to the decision."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.page.levels import Levels
from lightpage.page.phase_refit import PhaseRefit
from lightpage.page.pilots import PilotReading, Pilots, read_pilots, remove_piston, stroke_error

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Corrected:
    """A decoded page whose errors are taken off.

    Attributes:
        phase: radians [ny, nx], within half a turn.
        concentration: von Mises kappa as far as the pilots bear it out, [ny, nx].
        error: smooth error and flicker that were taken off, radians [ny, nx]; piston and crosstalk were too.
        reading: evidence of the pilots.
        stroke_relative: error of the modulator's stroke; NaN where pilots show nothing of it.
    """

    phase: Floats
    concentration: Floats
    error: Floats
    reading: PilotReading
    stroke_relative: float


def corrected(
    phase: NDArray[np.floating], concentration: NDArray[np.floating], levels: Levels, pilots: Pilots, refit: PhaseRefit
) -> Corrected:
    """Take piston, crosstalk, smooth error and flicker off a page.

    Args:
        phase: decoded, radians [ny, nx].
        concentration: its von Mises kappa as the network claims it, [ny, nx].
        levels: levels of the page.
        pilots: the known symbols of the page.
        refit: refit of the device's pages.
    """
    reading = read_pilots(_vectors(phase, concentration), pilots)
    if any(levels.crosstalk):
        still = _vectors(remove_piston(phase, reading.piston.angle_rad), concentration)
        phase = remove_piston(phase, levels.of_neighbours(still))
        reading = read_pilots(_vectors(phase, concentration), pilots)
    phase = remove_piston(phase, reading.piston.angle_rad)
    smooth = refit.error(phase, concentration, levels, pilots)
    sure = np.asarray(concentration * np.float32(reading.trust), np.float32)
    stroke = stroke_error(phase - smooth, sure, reading.sound)
    error = smooth + stroke.of_phases(phase)
    return Corrected(remove_piston(phase, error), sure, error, reading, stroke.relative)


def _vectors(phase: NDArray[np.floating], concentration: NDArray[np.floating]) -> NDArray[np.floating]:
    """Vectors p, [2, ny, nx], of such angles and lengths."""
    return np.asarray(concentration * np.stack([np.cos(phase), np.sin(phase)]))
