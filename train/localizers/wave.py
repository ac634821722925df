"""The wave localizer: the adjoint of the sheared pipe's simulation, run backwards with fitted parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from optics.profile import Profile
from optics.registration.fitted_waves import FittedWaves
from train.localizers.coherent import SAMPLES

Real = NDArray[np.float64]


class WaveLocalizer:
    """Runs the recovered field back through camera lens, pipe and launch lens to the SLM.

    Args:
        profile: the nominal device.
        parameters: [P] fitted (or, for an oracle, true) parameters of the ray twin; the wave model is made from them.
    """

    def __init__(self, profile: Profile, parameters: Real) -> None:
        self._waves = FittedWaves(profile, parameters, SAMPLES)
        self._shape = profile.page_shape

    def __call__(self, field: NDArray[np.complex64]) -> NDArray[np.float32]:
        """Field [Gy, Gx] to samples [2, 1, S, ny, nx], as the coherent localizer gives them with a single branch."""
        at_slm = self._waves.to_page(field)
        at_slm = at_slm / np.sqrt(np.mean(np.abs(at_slm) ** 2) + 1e-12)
        rows, columns = self._shape
        split = at_slm.reshape(rows, SAMPLES, columns, SAMPLES).transpose(1, 3, 0, 2).reshape(1, -1, rows, columns)
        return np.stack([split.real, split.imag]).astype(np.float32)
