"""Effects of a modulator on the phases that are written on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.device.state import SlmDefects

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]


def modulated(slm: SlmDefects, phase: Real, xp: Any = np) -> Complex:
    """Light that a modulator makes of levels of so much nominal phase, radians; of unit amplitude on average nearly.

    `xp` is the array library of the phases.
    """
    turn = phase + slm.stroke_relative_error * phase
    turn = turn + slm.level_sine_rad * xp.sin(phase) + slm.level_cosine_rad * xp.cos(phase)
    turn = turn + slm.level_sine_twice_rad * xp.sin(2 * phase) + slm.level_ripple_rad * xp.sin(20 * phase)
    amplitude = 1 + slm.level_amplitude_relative * xp.cos(phase)
    unmodulated = complex(slm.unmodulated_relative * np.exp(1j * slm.unmodulated_phase_rad))
    light: Complex = amplitude * xp.exp(1j * turn) + unmodulated
    return light


def with_crosstalk(phase: Real, share: float, xp: Any = np) -> Real:
    """Phases [ny, nx] of which each takes over a share of the step to each of its four neighbours."""
    if not share:
        return phase
    above, below = (xp.concatenate(rows) for rows in ((phase[:1], phase[:-1]), (phase[1:], phase[-1:])))
    before, after = (
        xp.concatenate(columns, 1) for columns in ((phase[:, :1], phase[:, :-1]), (phase[:, 1:], phase[:, -1:]))
    )
    mixed: Real = (1 - 4 * share) * phase + share * (above + below + before + after)
    return mixed


def dead_pixels(slm: SlmDefects, shape: tuple[int, int]) -> tuple[NDArray[np.bool_], Complex]:
    """Return the mask [ny, nx] of dead pixels, and their light [n]: of a constant phase, or zero."""
    rng = np.random.default_rng(slm.dead_pixel_seed)
    dead, turns, dark = rng.random(shape) < slm.dead_pixel_share, rng.random(shape), rng.random(shape) < 0.5
    return dead, np.where(dark, 0, np.exp(2j * np.pi * turns))[dead]
