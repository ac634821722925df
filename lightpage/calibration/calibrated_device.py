"""One device as calibration found it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import stand_apart
from lightpage.device.profile import Profile
from lightpage.page.modulation import NOMINAL, Modulation
from lightpage.recording.frame_pair import FramePair

if TYPE_CHECKING:
    from lightpage.calibration.document import Calibration


@dataclass(frozen=True)
class CalibratedDevice:
    """All that a field and its rays are computed with, beside the frames themselves.

    Attributes:
        profile: the nominal device.
        parameters: [P] fitted, see `lightpage.calibration.parameters`.
        quadrature_phase_rad: phase between the two cameras, about 90 degrees, negative where Q is inverted.
        references: reference-only frames.
        modulation: what the modulator makes of its levels.
    """

    profile: Profile
    parameters: NDArray[np.float64]
    quadrature_phase_rad: float
    references: FramePair
    modulation: Modulation = NOMINAL

    @property
    def stands_apart(self) -> bool:
        """Whether the cameras stand so far apart that each must be seen through a defocus of its own."""
        return stand_apart(self.parameters)

    @classmethod
    def of(cls, profile: Profile, calibration: Calibration, references: FramePair) -> Self:
        """The device of a calibration document."""
        return cls(profile, calibration.vector, calibration.turn_rad, references, calibration.modulator)
