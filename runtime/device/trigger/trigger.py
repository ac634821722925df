"""The interface of triggers: one call, one edge to both cameras; and one without a pulse generator."""

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from lightpage.runtime.device.cameras.camera import Camera


class Trigger(Protocol):
    """Fires both cameras. One thread at a time uses it."""

    name: str
    """For people, e.g. ``pulse generator /dev/ttyUSB0``."""

    def arm(self) -> None:
        """Connect unless that is done, and set it up; nothing is fired.

        Raises:
            SourceError: no such line, or it refuses a setting.
            LostShotError: `Reason.TRIGGER_GONE`: it has gone away.
        """

    def fire(self) -> float:
        """Fire once; returns when that was, by the clock of who pairs its frames.

        Raises:
            LostShotError: `Reason.TRIGGER_GONE`: it has gone away or does not answer, and may or may not have fired;
                `Reason.TRIGGER_REFUSED`: it answers that it cannot.
        """

    def disarm(self) -> None:
        """Fire no more; it stays connected."""

    def close(self) -> None:
        """Let go of it; `arm` connects again."""


class SoftwareTrigger:
    """Satisfies `Trigger`: fires cameras by `Camera.fire`, one after another.

    Their exposures are not simultaneous: between them lies a command over a camera's line, some 0.1 to 10 ms, and
    whatever else the machine does meanwhile. Light that changes in that time is seen differently by both.

    Args:
        cameras: cameras that are set up to be triggered by a command, first to last.
        clock: tells the time of a shot.
    """

    name = "software trigger"

    def __init__(self, cameras: Sequence[Camera], clock: Callable[[], float] = time.monotonic) -> None:
        self._cameras, self._clock = tuple(cameras), clock

    def arm(self) -> None:
        """See `Trigger`; the cameras are armed by those who use them."""

    def fire(self) -> float:
        """Fire all; returns the middle between the first command and the last answer.

        Raises:
            LostShotError: `Reason.CAMERA_GONE`: a camera has gone; those before it have been fired.
        """
        before = self._clock()
        for camera in self._cameras:
            camera.fire()
        return (before + self._clock()) / 2

    def disarm(self) -> None:
        """See `Trigger`."""

    def close(self) -> None:
        """See `Trigger`; the cameras stay open."""
