"""Where frame pairs come from when the service reads a page itself: a recording, a simulated device, later cameras."""

from __future__ import annotations

from lightpage.errors import InvalidInputError
from runtime.acquisition.recording import RecordingSource
from runtime.acquisition.simulator import open_simulator
from runtime.acquisition.source import FrameSource


class CameraSource:
    """Real cameras, which this version cannot drive.

    Raises:
        InvalidInputError: always.
    """

    def __init__(self, address: str) -> None:
        raise InvalidInputError(
            f"source camera:{address}",
            "a camera, for which this installation has no driver",
            "the camera extra (pip install 'lightpage[camera]') in a version that drives cameras, "
            "or recording:FILE or simulator:PROFILE",
        )


def open_source(spec: str) -> FrameSource:
    """Open a source by its name.

    Args:
        spec: ``recording:FILE``, ``simulator:PROFILE`` (a shipped name or a file), optionally followed by
            ``?levels=16&seed=0&device=FILE``, or ``camera:ADDRESS``.

    Raises:
        InvalidInputError: another name, or one whose recording, profile or device does not validate.
    """
    kind, colon, rest = spec.partition(":")
    if colon and rest and kind == "recording":
        return RecordingSource(rest)
    if colon and rest and kind == "simulator":
        return open_simulator(spec, rest)
    if colon and kind == "camera":
        # A constructor that only raises cannot be typed as the protocol.
        CameraSource(rest)
    raise InvalidInputError("source", repr(spec), "recording:FILE, simulator:PROFILE or camera:ADDRESS")
