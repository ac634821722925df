"""Defocus as a filter of light on a camera plane: a quadratic phase on the facet is a product of two short kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lightpage.waves.geometry import WaveGeometry

_REACH = 12
"""Samples to either side of a kernel's middle: for 1.5 rad at the facet's wall they hold all but 1e-4 of its power."""
_NODES = 512
_MARGIN = 1.05
"""Frequencies beyond those of the facet that are still filtered rightly: a turned pipe reaches further."""


def defocus_taps(geometry: WaveGeometry, defocus: float, pitch_m: float) -> NDArray[np.float32]:
    """Real and imaginary part of the kernel along either axis, [2, taps], odd and symmetric.

    Args:
        geometry: the device.
        defocus: factor of R^2 on the facet, rad/m^2.
        pitch_m: pitch of the samples.
    """
    frequency = (np.arange(_NODES) + 0.5) / _NODES * np.pi / pitch_m
    per_metre = geometry.focal_length_m / geometry.wave_number
    edge, highest = _MARGIN * geometry.pipe_width_m / 2 / per_metre, np.pi / pitch_m
    behind = np.clip((frequency - edge) / max(highest - edge, 1e-9 * highest), 0, 1)
    passed = np.cos(behind * np.pi / 2) ** 2 * np.exp(1j * defocus * (per_metre * frequency) ** 2)
    places = np.arange(-_REACH, _REACH + 1) * pitch_m
    taps = np.mean(passed * np.cos(np.outer(places, frequency)), axis=1)
    return np.stack([taps.real, taps.imag]).astype(np.float32)


def resampled_taps(step: float) -> NDArray[np.float64]:
    """Matrix [taps, taps] that takes a kernel along an axis to that of samples `step` times as far apart."""
    frequency, taps = (np.arange(_NODES) + 0.5) / _NODES * np.pi, np.arange(-_REACH, _REACH + 1)
    return np.asarray(np.cos(np.outer(taps, frequency)) @ np.cos(np.outer(frequency / step, taps)) / _NODES)
