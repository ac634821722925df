"""What a trigger is: one call, one edge to both cameras."""

from __future__ import annotations

from typing import Protocol


class Trigger(Protocol):
    """Fires both cameras. One thread at a time uses it."""

    @property
    def name(self) -> str:
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
