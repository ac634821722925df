"""What a recalibration found."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from lightpage.calibration.sampling_table import SamplingTable
from lightpage.progress import Progress
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.runtime.recalibration.known_pages import KnownPages


@dataclass(frozen=True)
class RefitReport:
    """What a fit says of itself; None where it does not know.

    Attributes:
        angle_deg: fitted pipe angle.
        coherence_before: of the pages with the old geometry, 0..1.
        coherence_after: with the new one.
        details: further numbers for people.
        image: where the image was found before the fit, against the earlier calibration.
    """

    angle_deg: float | None = None
    coherence_before: float | None = None
    coherence_after: float | None = None
    details: dict[str, float] = field(default_factory=dict)
    image: ImagePosition | None = None


@dataclass(frozen=True)
class RefitResult:
    """A re-fitted device.

    Attributes:
        table: re-traced tensors to feed to the decoder, by input name; those left out stay as they are.
        calibration_toml: the new calibration document.
        report: the fit's own figures.
    """

    table: SamplingTable
    calibration_toml: str
    report: RefitReport


class Refit(Protocol):
    """Re-fits the geometry with the exported twin and re-traces the table."""

    def __call__(self, bundle: Bundle, pages: KnownPages, progress: Progress, decoder: Decoder) -> RefitResult:
        """Fit on all `pages`.

        Raises:
            CalibrationError: the pages fit no geometry within the capture range.
        """


@dataclass(frozen=True)
class RecalibrationOutcome:
    """A new bundle and why it is better: AIR in bits per symbol on held-back pages, decoded as the service does it.

    `pages_lost_before` of these pages the earlier model would not have given out; they count with no bits. `air_limit`
    is the least `air_after` that would have been accepted, see `lightpage.runtime.recalibration.judgement.judge`, and
    `air_standard_error` that of the difference; None where an earlier version has judged.
    """

    path: Path
    version: str
    previous_version: str
    report: RefitReport
    air_before: float
    air_after: float
    pages_lost_before: int
    pages_used: int
    pages_held_back: int
    seconds: float
    air_limit: float | None = None
    air_standard_error: float | None = None
