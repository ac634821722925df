"""Effects of a modulator on the phases that are written on it."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from lightpage.device.state import SlmDefects

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]


def modulated(slm: SlmDefects, phase: Real) -> Complex:
    """Light that a modulator makes of levels of so much nominal phase, radians; of unit amplitude on average nearly."""
    turn = phase + slm.stroke_relative_error * phase
    turn = turn + slm.level_sine_rad * np.sin(phase) + slm.level_cosine_rad * np.cos(phase)
    turn = turn + slm.level_sine_twice_rad * np.sin(2 * phase)
    amplitude = 1 + slm.level_amplitude_relative * np.cos(phase)
    return np.asarray(amplitude * np.exp(1j * turn) + slm.unmodulated_relative * np.exp(1j * slm.unmodulated_phase_rad))


def with_crosstalk(phase: Real, share: float) -> Real:
    """Phases [ny, nx] of which each takes over a share of the step to each of its four neighbours."""
    if not share:
        return phase
    cross = np.array([[0, share, 0], [share, 1 - 4 * share, share], [0, share, 0]])
    return np.asarray(scipy.ndimage.convolve(phase, cross, mode="nearest"))


def dead_pixels(slm: SlmDefects, shape: tuple[int, int]) -> tuple[NDArray[np.bool_], Complex]:
    """Return the mask [ny, nx] of dead pixels, and their light [n]: of a constant phase, or zero."""
    rng = np.random.default_rng(slm.dead_pixel_seed)
    dead, turns, dark = rng.random(shape) < slm.dead_pixel_share, rng.random(shape), rng.random(shape) < 0.5
    return dead, np.where(dark, 0, np.exp(2j * np.pi * turns))[dead]
