"""The interface of cameras."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import LostShotError, Reason, SourceError
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.device.cameras.pixel_formats import bit_depth
from lightpage.runtime.device.cameras.settings import CameraSettings


@dataclass(frozen=True)
class Frame:
    """A frame as a camera delivered it.

    Attributes:
        pixels: counts [row, column], uint8 or uint16, right-aligned, native byte order.
        info: number, times, format, camera and exposure.
    """

    pixels: NDArray[np.unsignedinteger[Any]]
    info: FrameInfo


@dataclass(frozen=True)
class BrokenFrame:
    """A frame of which parts were lost on the way; nothing of it can be used, its number and time included.

    Attributes:
        detail: what is wrong with it, for people.
    """

    detail: str


class Camera(Protocol):
    """A camera that is triggered. One thread at a time uses it."""

    name: str
    """For people, e.g. ``in-phase camera (FLIR-12345678)``."""
    bit_depth: int
    """Bits of a count."""
    frame_numbers: int
    """After this number of a frame comes 1: 65535 where numbers have 16 bits and leave out 0."""
    opened: int
    """How often it was opened. A camera that was opened anew begins with other numbers and another clock."""

    def arm(self) -> None:
        """Open it unless it is open, set it up, drop frames from before; from here on a trigger makes a frame.

        Raises:
            SourceError: no such camera, or it does not take a setting.
            LostShotError: `Reason.CAMERA_GONE`: it has gone away.
        """

    def fire(self) -> None:
        """Trigger it by a command over its own line; only of a camera that is set up for that.

        Raises:
            LostShotError: `Reason.CAMERA_GONE`.
        """

    def frame(self, timeout_s: float) -> Frame | BrokenFrame | None:
        """The next frame, or None where none comes within `timeout_s`; 0 takes what is there already.

        Raises:
            LostShotError: `Reason.CAMERA_GONE`; also where the frame is not as the camera was set up, until `arm`.
        """

    def disarm(self) -> None:
        """Stop taking frames; it stays open."""

    def close(self) -> None:
        """Let go of it; `arm` opens it again."""


class DrivenCamera:
    """Base class of the drivers of `Camera`.

    Args:
        settings: which camera, and how it is set up.
        frame_shape: (rows, columns) of the region that is read.
        role: role for people, e.g. ``in-phase camera``.
    """

    def __init__(self, settings: CameraSettings, frame_shape: tuple[int, int], role: str = "camera") -> None:
        self._settings, self._shape, self._role = settings, frame_shape, role
        self.name = f"{role} ({settings.label})"
        self.bit_depth = bit_depth(settings.pixel_format)
        self.frame_numbers = 2**64 - 1
        self.opened = 0

    def _absent(self, was_there: bool, got: object, expected: str) -> SourceError | LostShotError:
        """The error of a camera that is not there: it has gone away only if it was there."""
        return self._gone(got, expected) if was_there else SourceError(self.name, got, expected)

    def _gone(self, got: object, expected: str = "a camera that answers") -> LostShotError:
        return LostShotError(self.name, got, expected, Reason.CAMERA_GONE)

    def _unarmed(self, is_open: bool) -> SourceError | LostShotError:
        was_there = self.opened > 0 and not is_open
        return self._absent(was_there, "a camera that is not armed", "`arm` before it is used")
