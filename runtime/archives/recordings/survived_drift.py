"""Drift that pages of a code survive, judged by pages that were recorded before the device drifted.

A table traced for a shifted geometry stands in for a device that has drifted the other way.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.document import Calibration
from lightpage.calibration.parameters import KNOWN, NAMES
from lightpage.codec.choose import FEWEST_PAGES, Choice, Drift, survives
from lightpage.errors import BundleError, InvalidInputError, LostPageError
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import SeenPages
from lightpage.runtime.archives.recordings.evaluation import check_recording, check_symbols, decode_unseen, pilots_of
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.recalibration import refitted_bundle
from lightpage.runtime.recalibration.refit import REFITTED, traced

_PAGES = FEWEST_PAGES
"""Number of pages that are read again for every drift, which costs all pages much the same."""

_STEPS = 6
_NEAR = 1.05
"""Ratio of the next amount to the largest that is read, below which the search ends."""
_AIM = 0.95
"""Share of the code's reserve that a step aims at, so that it stays readable."""
_STRIDE = 8.0
"""Largest factor, or divisor, of one step."""
_LEAST_COST = 1e-6


@dataclass(frozen=True)
class Kind:
    """Something that drifts.

    Attributes:
        told: name for people.
        unit: unit of an amount.
        usual: amount that is tried first.
        parameters: change of each parameter of a calibration by an amount of 1.
    """

    told: str
    unit: str
    usual: float
    parameters: Mapping[str, float]


_PLANES = ("modulator_axial_rad", "in_phase_axial_rad", "quadrature_axial_rad")
KINDS: dict[str, Kind] = {
    "angle": Kind("the pipe's angle", "degree", 0.003, {"pipe_angle_rad": np.pi / 180}),
    "camera": Kind("one camera's place", "px", 0.2, {"quadrature_shift_x_px": 1.0}),
    "focus": Kind("focus of modulator and cameras", "rad", 0.02, dict.fromkeys(_PLANES, 1.0)),
    "stroke": Kind("the modulator's stroke", "percent", 0.3, {"stroke_relative": 0.01}),
}


def moved(calibration: Calibration, amounts: Mapping[str, float]) -> Calibration:
    """The calibration of a device that has drifted by some amounts of `KINDS`."""
    parameters, modulation = dict(calibration.parameters), dict(calibration.modulation)
    for kind, amount in amounts.items():
        for name, share in KINDS[kind].parameters.items():
            (modulation if name in modulation else parameters)[name] += share * amount
    return calibration.model_copy(update={"parameters": parameters, "modulation": modulation})


class DriftedReading:
    """Reads the first pages of a recording as if the device had drifted.

    Args:
        decoder: decoder of the device.
        recording: recording with known symbols.

    Attributes:
        recording: recording that is read.
        kinds: names in `KINDS` that the decoder knows.

    Raises:
        BundleError: a decoder that holds its geometry itself, or has no calibration.
        RecordingError: another device's recording, or one without symbols.
        InvalidInputError: too few pages that the bundle has not seen and can decode.
    """

    def __init__(self, decoder: Decoder, recording: Recording) -> None:
        check_recording(decoder, recording)
        check_symbols(recording, "measure a drift by")
        if not REFITTED & decoder.graph.ports.keys():
            raise BundleError(f"{decoder.bundle.subject}: table inputs", sorted(decoder.graph.ports), "a geometry")
        self._decoder, self.recording, self._calibration = decoder, recording, decoder.bundle.calibration
        self._twin = OnnxTwin(decoder.bundle)
        told = self._decoder.taken({"parameters": self._calibration.vector}).get("parameters", NAMES[: KNOWN[0]])
        held = {*NAMES[min(len(told), self._twin.known) :]}
        self.kinds = {name: kind for name, kind in KINDS.items() if held.isdisjoint(kind.parameters)}
        self._pages: list[tuple[FramePair, NDArray[np.uint8]]] = []
        tracker, before = tracker_for(decoder), []
        for index in range(recording.pages):
            frames, symbols = recording.shown(index)
            try:
                page = decode_unseen(decoder, recording, tracker, pilots_of(decoder, recording), frames, symbols)
            except (InvalidInputError, LostPageError):
                continue
            if page is not None and symbols is not None:
                before.append((page, symbols))
                self._pages.append((frames, symbols))
            if len(before) == _PAGES:
                break
        if len(before) < _PAGES:
            raise InvalidInputError("pages to measure a drift by", len(before), f"at least {_PAGES}")
        self._before = SeenPages.of(decoder, recording, before)

    def drifted(self, amounts: Mapping[str, float]) -> Drift | None:
        """The pages, and what is read of them after a drift; None where a page is lost by it, whatever its code."""
        start, recording = self._decoder, self.recording
        result = traced(start, self._twin, start.references, moved(self._calibration, amounts))
        decoder, after = start.of_bundle(refitted_bundle(start.bundle, result)), []
        try:
            tracker = tracker_for(decoder)  # which reads the golden page, of before the drift
            for frames, symbols in self._pages:
                page = decode_unseen(decoder, recording, tracker, self._before.mask, frames, symbols)
                assert page is not None  # it was read before
                after.append((page, symbols))
        except (BundleError, InvalidInputError, LostPageError):
            return None
        return Drift(self._before.draw, SeenPages.of(decoder, recording, after).draw)

    def survived(self, choice: Choice, asked: Mapping[str, float]) -> dict[str, float]:
        """The largest amount of each kind, alone, that pages of a code survive; 0 where none that was tried.

        Args:
            choice: the code.
            asked: amounts to try first.
        """
        kinds = track(self.kinds.items(), "drifts", unit="kind", total=len(self.kinds))
        return {name: self._largest(name, choice, asked.get(name) or kind.usual) for name, kind in kinds}

    def _largest(self, kind: str, choice: Choice, amount: float) -> float:
        largest, failed = 0.0, np.inf
        for _ in range(_STEPS):
            drift = self.drifted({kind: amount})
            read, cost = (False, np.inf) if drift is None else survives(choice, drift, self._before.mask)
            largest, failed = (max(largest, amount), failed) if read else (largest, min(failed, amount))
            # a small drift costs by its square
            amount *= float(np.clip(np.sqrt(_AIM * choice.spare / max(cost, _LEAST_COST)), 1 / _STRIDE, _STRIDE))
            if amount >= failed:  # it is not information that is short, but corrections
                amount = float(np.sqrt(largest * failed)) if largest else failed / 2
            if amount < _NEAR * largest:
                break
        return largest
