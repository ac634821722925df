"""The tables of a bundle's device under drift: the image's shift is fed, a tilt against the reference is traced."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.interfaces import Twin
from lightpage.calibration.parameters import NAMES
from lightpage.calibration.phases import tilt_of_shift
from lightpage.calibration.sampling_table import SamplingTable, sampling_table, shifted
from lightpage.runtime.model.bundle.calibrated import calibration_of
from lightpage.runtime.model.decoding.decoder import Decoder

Real = NDArray[np.float64]


class DriftTables(Protocol):
    """Applies drift to the tables of a decoder."""

    def shifted(self, shift_px: Real) -> SamplingTable:
        """Tensors to feed for an image `shift_px` (x, y) from where calibration saw it; empty for no shift."""

    def traced(self, tilt_rad: Real) -> Decoder:
        """The decoder with the table of a device whose signal is tilted so against the reference."""

    def tilt_of(self, shift_px: Real) -> Real:
        """Tilt (x, y) of the signal against a reference that stays while the image shifts, radians."""


class BundleTables:
    """The tables of a bundle's device under drift.

    Args:
        decoder: of the bundle as it is.
        twin: of the bundle.

    Raises:
        CalibrationError: the bundle holds no calibration.
    """

    def __init__(self, decoder: Decoder, twin: Twin) -> None:
        self._decoder, self._twin, self._calibration = decoder, twin, calibration_of(decoder.bundle)
        self._registration = decoder.graph.value("registration")

    def shifted(self, shift_px: Real) -> SamplingTable:
        """See `DriftTables`."""
        return {"registration": shifted(self._registration, shift_px)} if np.any(shift_px) else {}

    def tilt_of(self, shift_px: Real) -> Real:
        """See `DriftTables`."""
        profile = self._decoder.bundle.profile
        half = profile.page_width_m / 2, profile.page_height_m / 2
        return tilt_of_shift(self._calibration.parameters, shift_px * profile.camera.pitch_m, *half)

    def traced(self, tilt_rad: Real) -> Decoder:
        """See `DriftTables`."""
        bundle = self._decoder.bundle
        parameters = self._calibration.vector.copy()
        for name, tilt in zip(("camera_tilt_x_rad", "camera_tilt_y_rad"), tilt_rad, strict=True):
            parameters[NAMES.index(name)] += tilt
        table = sampling_table(self._twin, parameters, self._calibration.turn_rad, bundle.profile)
        return self._decoder.with_table({n: v for n, v in table.items() if n in self._decoder.graph.ports})
