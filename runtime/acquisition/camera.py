"""Real cameras, which this version cannot drive."""

from __future__ import annotations

from lightpage.errors import InvalidInputError
from runtime.acquisition.source import FrameSource


def open_camera(rest: str) -> FrameSource:
    """Say that there is no driver.

    Raises:
        InvalidInputError: always.
    """
    raise InvalidInputError(
        f"source camera:{rest}",
        "a camera, for which this installation has no driver",
        "the camera extra (pip install 'lightpage[camera]') in a version that drives cameras, "
        "or recording:FILE or simulator:PROFILE",
    )
