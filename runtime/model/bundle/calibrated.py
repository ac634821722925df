"""The calibration document of a bundle."""

from __future__ import annotations

from lightpage.calibration.document import Calibration, parse_calibration
from lightpage.errors import CalibrationError, ProfileError
from lightpage.runtime.model.bundle.bundle import Bundle


def calibration_of(bundle: Bundle) -> Calibration:
    """The calibration that the bundle was made with.

    Raises:
        CalibrationError: its text is no calibration of its profile.
    """
    try:
        calibration = parse_calibration(bundle.manifest.calibration, f"{bundle.subject}: calibration")
        calibration.check_profile(bundle.profile)
    except ProfileError as error:
        raise CalibrationError(error.subject, error.got, error.expected) from None
    return calibration
