"""Position of a page's image."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ImagePosition:
    """Position of a page's image on the cameras.

    Attributes:
        shift_x_px, shift_y_px: against where calibration saw it, camera pixels, on both cameras.
        tilt_x_rad, tilt_y_rad: of the signal against the reference since calibration, radians at the right and lower
            edge of the page's image.
        searched: whether it was looked for.
        found: whether the search found it; False where none was made.
    """

    shift_x_px: float
    shift_y_px: float
    tilt_x_rad: float = 0.0
    tilt_y_rad: float = 0.0
    searched: bool = False
    found: bool = False
