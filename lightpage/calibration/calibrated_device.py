"""Calibrated device: the parameters, phases and references that decoders need of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import apart_inputs
from lightpage.device.profile import Profile
from lightpage.page.modulation import NOMINAL, Modulation
from lightpage.recording.frame_pair import FramePair


@dataclass(frozen=True)
class CalibratedDevice:
    """Calibrated device: all that a field and its rays are computed with, beside the frames themselves.

    Attributes:
        profile: the nominal device.
        parameters: [P] fitted, see `lightpage.calibration.parameters`.
        quadrature_phase_rad: phase between the two cameras, about 90 degrees, negative where Q is inverted.
        references: reference-only frames.
        modulation: light that the modulator makes of its levels.
    """

    profile: Profile
    parameters: NDArray[np.float64]
    quadrature_phase_rad: float
    references: FramePair
    modulation: Modulation = NOMINAL

    @property
    def apart_inputs(self) -> tuple[str, ...]:
        """See `lightpage.calibration.sampling_table.apart_inputs`."""
        return apart_inputs(self.parameters)
