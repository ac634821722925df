"""Result of the demo: its phases, the drift between them, and the healing."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.codec.code import Code
from lightpage.codec.volume import Volume
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.archives.recordings.coded_pages import AIR_LEVELS
from lightpage.runtime.recalibration.recalibration import RecalibrationOutcome

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Phase:
    """Phase of the demo: what was decoded in one state of the device.

    Attributes:
        name: the state.
        model_version: the last page's.
        air: per data symbol, bits, mean over the pages that were decoded, [ny, nx]; not a number at pilots.
        confidence: mean over them, [ny, nx].
        symbol_error_rate: error rate of data symbols.
        seconds: seconds of one decode in the service, median.
        pages: number of pages that were read.
        unread: number of them that gave no bytes.
        restored, lost: pages of the picture that parity gave back, and that are lost.
        margin_bits: least margin of the pages that gave bytes, bits a symbol; None where none did.
        picture: picture as it was read, lost bytes black, [rows, columns].
        exact: whether it is the picture that was written.
    """

    name: str
    model_version: str
    air: Floats
    confidence: Floats
    symbol_error_rate: float
    seconds: float
    pages: int = 0
    unread: int = 0
    restored: int = 0
    lost: int = 0
    margin_bits: float | None = None
    picture: NDArray[np.uint8] | None = None
    exact: bool = False

    @property
    def air_bits_per_symbol(self) -> float:
        """AIR over all data symbols."""
        return float(np.nanmean(self.air))

    def to_json(self) -> dict[str, Any]:
        """The figures under names that other programs read."""
        return {
            "name": self.name,
            "model_version": self.model_version,
            "air_bits_per_symbol": self.air_bits_per_symbol,
            "mean_confidence": float(self.confidence.mean()),
            "symbol_error_rate": self.symbol_error_rate,
            "seconds_per_page": self.seconds,
            "pages": self.pages,
            "pages_unread": self.unread,
            "pages_restored": self.restored,
            "pages_lost": self.lost,
            "margin_bits_least": self.margin_bits,
            "picture_exact": self.exact,
        }


@dataclass(frozen=True)
class DemoCalibration:
    """Calibration of the demo's device.

    Attributes:
        pages: number of known pages.
        seconds: seconds from the first shot to the bundle.
        angle_deg: angle of the pipe, degrees.
    """

    pages: int
    seconds: float
    angle_deg: float


@dataclass(frozen=True)
class DriftStep:
    """Step of the drift: what one page told.

    Attributes:
        share: share of the drift of `drifted`.
        margin_bits: margin of the page, bits a symbol; None where it was not decoded.
        recalibration_due: whether its pilots show the drift.
        lost: whether it gave no bytes.
    """

    share: float
    margin_bits: float | None
    recalibration_due: bool
    lost: bool


@dataclass(frozen=True)
class DemoResult:
    """Result of the demo: three phases, the drift and the healing between them, and one frame pair with its page."""

    phases: tuple[Phase, ...]
    drift: tuple[DriftStep, ...]
    healed: RecalibrationOutcome
    frames: FramePair
    symbols: NDArray[np.uint8]
    code: Code
    volume: Volume
    seed: int
    source: str = ""
    shots: dict[str, int] = field(default_factory=dict)
    """Shots of the cameras by how they ended; empty without cameras."""
    calibration: DemoCalibration | None = None
    """Calibration of the device; None where the bundle was its own."""

    def story(self) -> tuple[str, ...]:
        """Return the story of the demo for people, in lines of some 120 characters."""
        fresh, lost, again = (phase.air_bits_per_symbol for phase in self.phases)
        margin, healed, volume = self.phases[0].margin_bits, self.healed, self.volume
        spare = "" if margin is None else f" Their code has a margin of {margin:.2f} bit a symbol."
        angle = healed.report.angle_deg
        found = "" if angle is None else f" It found the pipe's angle: {angle:.3f} degree."
        rounds = f"{healed.rounds} round{'' if healed.rounds == 1 else 's'}"
        calibrated = self.calibration
        begun = (
            ()
            if calibrated is None
            else (
                f"{calibrated.pages} known pages calibrate the device in {calibrated.seconds:.0f} s, without training. "
                f"Its pipe's angle: {calibrated.angle_deg:.3f} degree.",
            )
        )
        return (
            *begun,
            f"A picture of {volume.file_bytes} bytes lies on {volume.pages} pages, one spoilt on purpose.{spare}",
            f"The device drifts, AIR falls from {fresh:.2f} to {lost:.2f} bit a symbol, and no known page is shown.",
            f"The model heals by lost pages of user data: {rounds}, AIR {again:.2f} again.{found}",
        )

    def to_json(self) -> dict[str, Any]:
        """The figures under names that other programs read."""
        healed = self.healed
        return {
            "seed": self.seed,
            "source": self.source,
            "calibration": None if self.calibration is None else asdict(self.calibration),
            "shots": self.shots,
            "pages": self.volume.pages,
            "levels": self.code.levels,
            "air_levels": AIR_LEVELS,
            "code": self.code.model_dump(),
            "volume": self.volume.to_json(),
            "phases": [phase.to_json() for phase in self.phases],
            "drift": [asdict(step) for step in self.drift],
            "healing": {
                "model_version": healed.version,
                "previous_version": healed.previous_version,
                "rounds": healed.rounds,
                "pages_used": healed.pages_used,
                "pages_held_back": healed.pages_held_back,
                "seconds": healed.seconds,
                "angle_deg": healed.report.angle_deg,
                "air_before": healed.air_before,
                "air_after": healed.air_after,
                "coherence_before": healed.report.coherence_before,
                "coherence_after": healed.report.coherence_after,
            },
        }
