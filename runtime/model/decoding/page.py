"""The forms of a page on its way through the decoder."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError, FramesDisagreeError
from lightpage.page.pilots import PilotCheck
from lightpage.runtime.model.bundle.manifest import Manifest
from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.von_mises import information
from lightpage.words import brief, sides

OUTPUTS = ("p", "phase", "concentration")
"""Of a decoder's graph."""
_SYMBOLS = 4096
"""Symbols at most by which a page's information is estimated: their mean is exact to a few thousandths, and soon taken.
"""


class StepLimit(NamedTuple):
    """Limit on the time of a page's Gauss-Newton steps.

    Attributes:
        least: fewest steps that the page may have, 1 or more.
        seconds_left: returns the time left for the first estimate and the steps, seconds.
    """

    least: int
    seconds_left: Callable[[], float]


@dataclass(frozen=True)
class Inference:
    """Output of the graph for a page: p float32 [2, ny, nx], its angle and length [ny, nx]; piston still in it.

    The length is zero where a camera does not show the symbol, whatever p is.

    `residual` is what the bundle judges its pages by, zero where it names no output for that: the power that is left of
    the homodyne equations over the field's, or of an estimator the mean square of the counts' residuals over their
    variance, not finite for frames without the light of a page. `waited_s` are the seconds for which the page waited
    for others of its batch. An estimator also says by what `drift` the page's light lies off the table, [4] as in
    `lightpage.runtime.model.decoding.image_drift`, by what complex `gain` it has taken off the page's light, and its
    number of Gauss-Newton `steps`; there was no time for `skipped_steps` more.
    """

    p: NDArray[np.float32]
    phase: NDArray[np.float32]
    concentration: NDArray[np.float32]
    residual: float = 0.0
    waited_s: float = 0.0
    drift: NDArray[np.float64] | None = None
    gain: complex | None = None
    steps: int = 0
    skipped_steps: int = 0

    @property
    def brightness(self) -> float:
        """Power of the page's light over that of the calibration's; NaN of a network's bundle."""
        return math.nan if self.gain is None else abs(self.gain) ** 2

    def whole_piston(self, angle_rad: float) -> float:
        """Piston of the page, radians, whose phases have a common angle."""
        taken_off = 0.0 if self.gain is None else cmath.phase(self.gain)
        return math.remainder(angle_rad + taken_off, 2 * math.pi)

    def turned(self, by: NDArray[np.floating]) -> Inference:
        """The same with `by` (radians [ny, nx]) added to the phases."""
        phase = (self.phase + by).astype(np.float32)
        p = self.concentration * np.stack([np.cos(phase), np.sin(phase)])
        return replace(self, p=p, phase=phase)


@dataclass(frozen=True)
class Timings:
    """Wall-clock seconds of one page, and its Gauss-Newton steps, every attempt at it counted.

    Attributes:
        check_s: checks of the frames.
        inference_s: runs of the graph.
        decision_s: piston, tracking and decision.
        search_s: looking for the image.
        waiting_s: waiting for the other pages of a batch, and for the batch before it.
        turn_s: waiting for the pages before it, behind which it is followed.
        steps: number of Gauss-Newton steps of all inferences of the page; 0 for a network's bundle.
        skipped_steps: number of steps that these inferences lack, since the caller's time was short.
    """

    check_s: float
    inference_s: float
    decision_s: float
    search_s: float = 0.0
    waiting_s: float = 0.0
    turn_s: float = 0.0
    steps: int = 0
    skipped_steps: int = 0

    def with_steps(self, inference: Inference) -> Timings:
        """The same times with the steps of one more inference."""
        skipped = self.skipped_steps + inference.skipped_steps
        return replace(self, steps=self.steps + inference.steps, skipped_steps=skipped)

    @property
    def waited_s(self) -> float:
        """Time that the page waited for other pages."""
        return self.waiting_s + self.turn_s

    @property
    def worked_s(self) -> float:
        """Time of the page's own work, without waiting."""
        return self.check_s + self.inference_s + self.decision_s + self.search_s

    @property
    def total_s(self) -> float:
        """Time of the decode, waiting included."""
        return self.worked_s + self.waited_s


@dataclass(frozen=True, repr=False)
class DecodedPage:
    """A page of symbols with what is known about each.

    Attributes:
        symbols: uint8 [ny, nx], 0..levels-1.
        confidence: float32 [ny, nx], posterior probability of each symbol among the levels.
        concentration: float32 [ny, nx], von Mises kappa as far as the pilots bear it out.
        phase: float32 [ny, nx], radians, piston removed.
        levels: M.
        piston_rad: piston that was removed.
        pilot_coherence: how far the pilots agree on it, 0..1.
        pilot_trust: share of the network's claimed concentration that they bear out, 0..1; low after a drift.
        check: information that is claimed of the pilots, and what of it they confirm.
        timings: seconds.
        phase_error: float32 [ny, nx], smooth error and flicker that were taken off `phase`, radians.
        level_phases: phase that stands for each level, radians; None where level s is 2 pi s / M.
        image: where the image lies as this page shows it, None where it is not followed.
        brightness: power of the page's light over that of the calibration's; NaN of a network's bundle.
        stroke_relative: what the pilots show of the modulator's stroke beyond its calibration; NaN where they show
            nothing of it.
    """

    symbols: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    concentration: NDArray[np.float32]
    phase: NDArray[np.float32]
    levels: int
    piston_rad: float
    pilot_coherence: float
    pilot_trust: float
    check: PilotCheck
    timings: Timings
    phase_error: NDArray[np.float32]
    level_phases: tuple[float, ...] | None = None
    image: ImagePosition | None = None
    brightness: float = np.nan
    stroke_relative: float = np.nan

    def __repr__(self) -> str:
        symbols = f"{sides(self.symbols.shape)} symbols of {self.levels} levels"
        claimed = f"confidence {self.confidence.mean():.3f}, {self.information_bits:.2f} bits a symbol"
        return brief(self, symbols, claimed, f"pilot coherence {self.pilot_coherence:.2f}")

    @cached_property
    def information_bits(self) -> float:
        """Information that the page claims of a symbol's phase, bits, the mean of many symbols.

        It is claimed as far as the pilots bear it out, and does not depend on how many levels there are.
        """
        concentration = self.concentration.ravel()
        few = concentration[:: -(-concentration.size // _SYMBOLS)]
        return float(information(few.astype(np.float64)).mean() / np.log(2))

    @cached_property
    def residual_rad(self) -> float:
        """Smooth phase error that was taken off the page, root mean square, radians."""
        return float(np.sqrt(np.mean(np.square(self.phase_error))))


def check_residual(residual: float, manifest: Manifest, *, doubtful: bool = False) -> None:
    """Check the residual of a pair of frames, see `Inference`.

    Args:
        residual: residual of the page.
        manifest: manifest of the bundle, with the name of its residual, and the limit.
        doubtful: see `lightpage.runtime.model.decoding.decoder.Decoder.infer`.

    Raises:
        FrameError: as `Decoder.infer` says.
    """
    seen, limit = np.isfinite(residual), manifest.residual_limit
    if limit is not None and not residual <= limit and not (doubtful and seen):
        name = (manifest.residual_output or "residual").replace("_", "-")
        whom = "each other" if name == "residual" else "each other or the calibration"
        got = f"frames that contradict {whom} ({name} {residual:.3g})"
        raise (FramesDisagreeError if seen else FrameError)(
            "frame pair",
            got if seen else "no light of a page over the reference beam",
            f"an in-phase and a quadrature frame of one shot, not swapped, cameras and exposure as they were "
            f"calibrated ({name} up to {limit:.3g}; where frames are right, recalibrate)",
        )
