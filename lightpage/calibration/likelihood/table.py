"""Tensors of a device that maximum likelihood needs beside its sampling table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.likelihood.counts import CountStatistics
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.calibration.waves.wave_model import LaunchConditions
from lightpage.device.profile import Profile
from lightpage.page.modulation import Modulation
from lightpage.page.pilots import Pilots
from lightpage.waves.grid import symbol_samples

HARMONICS = 6
"""Order of the series of the amplitude over the phase of light."""
_FINE = 512
PILOT_PHASORS, PILOT_MASK = "pilot_phasors", "pilot_mask"
"""Names of the tensors that differ from page to page, with the levels that are written."""


def launch_tensors(profile: Profile, conditions: LaunchConditions, modulation: Modulation) -> SamplingTable:
    """Tensors of the light that is launched.

    Args:
        profile: nominal device.
        conditions: illumination and blur of a known page.
        modulation: light that the modulator makes of its levels.

    Returns:
        blur []; illumination [2, 6], of one sample that stands for a symbol, without its phase; amplitude_series [13],
        see `lightpage.train.models.likelihood.modulator`.
    """
    one_sample = symbol_samples(profile) * np.exp(-1j * np.angle(conditions.illumination[0]))
    coefficients = conditions.illumination * one_sample
    return {
        "blur": np.array(conditions.blur, np.float32),
        "illumination": np.stack([coefficients.real, coefficients.imag]).astype(np.float32),
        "amplitude_series": amplitude_series(modulation),
    }


def amplitude_series(modulation: Modulation) -> NDArray[np.float32]:
    """Fourier series of the logarithm of the amplitude over the phase of the light, [1 + 2 HARMONICS]."""
    light = modulation.light(2 * np.pi * (np.arange(_FINE) + 0.5) / _FINE)
    phase = np.angle(light)
    turns = [function(number * phase) for number in range(1, HARMONICS + 1) for function in (np.cos, np.sin)]
    terms = np.stack([np.ones(_FINE), *turns], axis=1)
    return np.asarray(np.linalg.lstsq(terms, np.log(np.abs(light)), rcond=None)[0], np.float32)


def count_tensors(statistics: tuple[CountStatistics, CountStatistics], correlation: float) -> SamplingTable:
    """Look-up tables of both cameras' counts: count_scale [2] and count_weights [2, 4, KNOTS]."""
    return {
        "count_scale": np.array([camera.scale for camera in statistics], np.float32),
        "count_weights": np.stack([camera.weights(correlation) for camera in statistics]),
    }


def pilot_tensors(pilots: Pilots) -> SamplingTable:
    """Known phasors [2, ny, nx] of the pilots, and 1 where a symbol is a pilot, else 0, [ny, nx]."""
    phases = np.zeros(pilots.mask.shape)
    phases[pilots.mask] = pilots.phases
    return {
        PILOT_PHASORS: np.stack([np.cos(phases), np.sin(phases)]).astype(np.float32),
        PILOT_MASK: pilots.mask.astype(np.float32),
    }
