"""Re-fits the device's geometry with the exported twin and re-traces the sampling table."""

from __future__ import annotations

from optics.errors import CalibrationError
from runtime.bundle import Bundle
from runtime.decoder import Decoder
from runtime.recalibration import FitResult, KnownPages, Progress


def refit(bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> FitResult:
    """Fit on `pages`, starting from the bundle's calibration.

    Raises:
        CalibrationError: the pages fit no geometry within the capture range.
    """
    raise CalibrationError("re-fit", "a version without the geometry fit", "a version that has it")
