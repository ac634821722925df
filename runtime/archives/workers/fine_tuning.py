"""Deep recalibration: another package brings it by an entry point of the group `lightpage.recalibrations`."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from lightpage.errors import LightpageError
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.run.task import FineTuning

if TYPE_CHECKING:
    from lightpage.runtime.model.decoding.decoder import Decoder
    from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome

GROUP, DEEP = "lightpage.recalibrations", "deep"


class DeepRecalibration(Protocol):
    """Finds a device's geometry, trains its network on, and makes a new bundle."""

    def check(self, bundle: Path, run: Path | None, pages: int) -> None:
        """Check that a device has what it needs, without looking at its pages.

        Args:
            bundle: bundle in service.
            run: folder of the training run that it was made from; None where it is not named.
            pages: pages with known symbols.

        Raises:
            LightpageError: it has not.
        """

    def recalibrate(
        self,
        decoder: Decoder,
        recording: Recording,
        run: Path,
        folder: Path,
        out: Path,
        choices: FineTuning,
        pages: int,
        progress: Progress,
    ) -> RecalibrationOutcome:
        """Recalibrate a device, or go on with it, and write a new bundle to `out` if it is not worse.

        Args:
            decoder: decoder of the bundle in service.
            recording: recording with known symbols.
            run: folder of the training run that the bundle was made from.
            folder: where the work is kept; what is finished in it is not done again.
            out: a new path.
            choices: how to train.
            pages: how many of the recording's pages that show light to use, at most.
            progress: told of every step.

        Raises:
            RecalibrationRefusedError: the new model would decode the held-back pages worse.
            CalibrationError: the pages fit no geometry.
            LightpageError: what is there cannot be used.
        """


def deep_recalibration() -> DeepRecalibration:
    """The deep recalibration that is installed.

    Raises:
        LightpageError: there is none.
        ModuleNotFoundError: what it needs is not installed: the extra train brings it.
    """
    for point in entry_points(group=GROUP, name=DEEP):
        made: DeepRecalibration = point.load()
        return made
    raise LightpageError("deep recalibration", f"no entry point {DEEP} of {GROUP}", "a complete installation")
