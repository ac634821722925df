"""Inputs and results that all trainers share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lightpage.calibration.document import Calibration
from lightpage.device.profile import Profile
from lightpage.page.levels import Levels
from lightpage.recording.reader import Recording
from lightpage.train.data.features import FeatureExtractor
from lightpage.train.processes import Processes


@dataclass(frozen=True)
class TrainingInputs:
    """A recording of a calibrated device, split.

    Attributes:
        out: folder of the run.
        recording: open recording with symbols.
        profile: the nominal device.
        calibration: the fitted device.
        extractor: extractor of the calibrated device, for the run's localizer.
        training, validation: page numbers.
        pilot_mask: bool [ny, nx].
        key: digest of profile, recording and calibration.
        processes: processes of the training.
    """

    out: Path
    recording: Recording
    profile: Profile
    calibration: Calibration
    extractor: FeatureExtractor
    training: list[int]
    validation: list[int]
    pilot_mask: NDArray[np.bool_]
    key: str
    processes: Processes

    @property
    def levels(self) -> Levels:
        """Levels of the recording's pages, as the device shows them."""
        return self.calibration.modulator.page_levels(self.recording.levels)


@dataclass(frozen=True)
class Trained:
    """A trained decoder.

    Attributes:
        weights: weights by name.
        validation_air: bits per data symbol.
        kappa_scale: factor on p that calibrates the claimed concentration on the validation pages.
        seconds: preparing the pages and training, all stretches together.
        synthetic_pages: trained on beside the recorded ones.
    """

    weights: dict[str, Tensor]
    validation_air: float
    kappa_scale: float
    seconds: float
    synthetic_pages: int = 0
