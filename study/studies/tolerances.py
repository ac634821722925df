"""Study of tolerances: AIR of a kept decoder, re-fitted by two known pages, as each knob of a device moves.

The device of the simulator is turned at one knob after the other. Three decoders read the same pages of it. All have
one pass by waves.

- *re-fitted*: the weights of the device as it was; geometry and levels calibrated from nominal on two known pages.
- *told*: the same weights; geometry, levels and angle between the arms are the true ones, as far as calibrations have
  numbers for them. This oracle says what the re-fit costs; it is told nothing of what calibrations do not fit.
- *trained anew*: the re-fitted decoder, trained on pages of this device from the kept weights on; at three values at
  most, and only where it reads clearly less than the device that taught it.

What the first loses and the last does not is the kept weights' fault, and training mends it. What both lose is gone
from the light, or from the model of the device.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lightpage.calibration.document import Calibration
from lightpage.device.state import Device
from lightpage.errors import CalibrationError, InvalidInputError
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from lightpage.simulator.true_optics import perfectly_calibrated
from lightpage.study.kept import KeptDecoder, Teaching, taught
from lightpage.study.knobs import KNOBS, Knob
from lightpage.study.known import FITTED_PAGES, Known
from lightpage.study.study import Case, Result, Row, Settings, Study, load_result
from lightpage.train.trainers.calibration import calibrate_recording

Real = NDArray[np.float64]

LOSS = 0.1
"""Bits a symbol that a knob within its range costs at most."""
_KEPT = "kept"
_TEACHING, _QUICK_TEACHING = Teaching(24, 24, 600), Teaching(12, 0, 150)
_ANEW = Teaching(24, 0, 300)
_JUDGED = 2
"""Pages that are read: ten thousand symbols of the bench device, whose AIR is known to 0.01 bit."""
_QUICK_KNOBS = ("stroke", "modulator-axial", "keystone", "phase-noise")
_QUICK_VALUES = (2, -1)
"""Places of a knob's values."""
_ANEW_VALUES = 3
_COLUMNS, _TITLE, _TICKS = 5, 32, 5
_LOSSES = (0.0, LOSS, 0.3, 1.0, 3.0)
"""Losses that are named at the axis, which is linear up to `LOSS` and logarithmic beyond."""
_CURVES = {
    "air": ("re-fitted", "o-", "tab:blue"),
    "told": ("told the true state", ".--", "tab:orange"),
    "anew": ("trained anew", "^", "tab:green"),
}
"""Curves of a picture, by the names of results: label, style, colour."""


@dataclass(frozen=True)
class Range:
    """Values of a knob at which no more than so much is lost.

    Attributes:
        low, high: ends of the range.
        below, above: whether it ends there because more is lost beyond, and not because no more was measured.
    """

    low: float
    high: float
    below: bool
    above: bool

    @classmethod
    def of(cls, values: Real, airs: Real, at: float, least: float) -> Range:
        """Find the range about a value from AIRs, ascending values; between two values the AIR is a straight line.

        Args:
            values: values of the knob, [N], ascending.
            airs: bits a symbol, [N].
            at: value from which the range is looked for outwards.
            least: AIR that it must have.
        """
        nearest = int(np.argmin(np.abs(values - at)))
        low, below = _outwards(values[nearest::-1], airs[nearest::-1], least)
        high, above = _outwards(values[nearest:], airs[nearest:], least)
        return cls(low, high, below, above)

    def text(self, factor: float = 1.0, least: float | None = None) -> str:
        """Tell both ends; `<` and `>` say that no more was lost as far as was measured.

        Args:
            factor: factor on the numbers, for another unit.
            least: value below which there is none.
        """
        low = "" if self.below or self.low == least else "<"
        return f"{low}{_short(factor * self.low)} to {'' if self.above else '>'}{_short(factor * self.high)}"


def _short(value: float) -> str:
    """Two digits of a number."""
    return f"{float(f'{value:.2g}'):g}"


def _outwards(values: Real, airs: Real, least: float) -> tuple[float, bool]:
    """The value at which AIRs first fall below `least`; the last one where they never do, and whether they do."""
    for (here, air), (there, less) in pairwise(zip(values, airs, strict=True)):
        if less < least:
            return float(here + (there - here) * (air - least) / (air - less)), True
    return float(values[-1]), False


def _device(settings: Settings) -> Device:
    """The device that the kept decoder was trained on."""
    return Device().of_profile(settings.profile)


def _cases(settings: Settings) -> list[Case]:
    cases: list[Case] = [{"name": _KEPT, "needed": True}]
    for name, knob in KNOBS.items():
        if settings.quick and name not in _QUICK_KNOBS:
            continue
        values = [knob.values[place] for place in _QUICK_VALUES] if settings.quick else knob.values
        anew = () if settings.quick else knob.values[::-2][:_ANEW_VALUES]
        of_knob = {"knob": name, "at": knob.at(_device(settings))}
        cases += [{"name": f"{name}={value:g}", **of_knob, "value": value, "anew": value in anew} for value in values]
    return cases


def _measure(settings: Settings, case: Case, work: Path, progress: Progress) -> Result:
    device, kept, least = _device(settings), work.parent / _KEPT, -math.inf
    if case["name"] == _KEPT:

        def calibration(recording: Recording) -> Calibration:
            return calibrate_recording(recording, settings.profile, range(FITTED_PAGES), _part(progress, 0.0, 0.2))

        teaching = _QUICK_TEACHING if settings.quick else _TEACHING
        taught(kept, settings.profile, device, teaching, settings.seed, calibration)
    else:
        device = KNOBS[case["knob"]].turned(device, case["value"])
        if case["anew"]:
            least = load_result(kept.with_suffix(".json"))["air"] - LOSS
    return _read(settings, kept / "run", device, work, progress, least)


def _part(progress: Progress, first: float, last: float) -> Progress:
    """Progress of a part of a case's work."""
    return lambda what, share: progress(what, first + share * (last - first))


def _read(settings: Settings, kept: Path, device: Device, work: Path, progress: Progress, least: float) -> Result:
    """Measure what decoders read of a device.

    Args:
        settings: settings of the study.
        kept: run of the decoder that is kept.
        device: device that is read.
        work: folder of the case.
        progress: told of every step.
        least: AIR below which it is trained anew.

    Returns:
        air, told, anew: bits a symbol, re-fitted, told and trained anew; not a number where that was not trained, and
            0 where calibration refuses the pages; refused: what it says then, or training of pages that are saturated.
    """
    profile, decoder = settings.profile, KeptDecoder.of(kept)
    progress("simulate", 0.5)
    pages = Known.of(profile, device, FITTED_PAGES + _JUDGED, settings.seed)
    fitted, judged = pages.part(slice(FITTED_PAGES)), pages.part(slice(FITTED_PAGES, None))
    told = decoder.air(perfectly_calibrated(profile, device, pages.references), judged)
    result: dict[str, Any] = {"air": 0.0, "told": told, "anew": math.nan, "refused": ""}
    try:
        calibration = fitted.calibration(profile, _part(progress, 0.6, 0.8))
        found = calibration.device(profile, pages.references)
        result["air"] = decoder.air(found, judged)
        if result["air"] < least:
            progress("train anew", 0.8)
            trained = taught(work, profile, device, _ANEW, settings.seed, lambda _: calibration, kept)
            result["anew"] = trained.air(found, judged)
    except (CalibrationError, InvalidInputError) as error:
        result["refused"] = str(error)
    return result


@dataclass(frozen=True)
class _Curve:
    """Results for a device over one of its knobs.

    Attributes:
        knob: knob that is turned.
        at: value of the knob on the device that was trained on.
        values: values of the knob, [N], ascending; that one is among them.
        results: results at each value.
    """

    knob: Knob
    at: float
    values: Real
    results: Sequence[Result]

    def airs(self, name: str) -> Real:
        """Bits a symbol, [N]: none where less than none is read, and not a number where nothing was measured."""
        return np.maximum([result[name] for result in self.results], 0.0)

    def measured(self, name: str) -> bool:
        """Return whether there is a number at a value other than that of the device that was trained on."""
        return bool(np.count_nonzero(np.isfinite(self.airs(name))) > 1)

    @property
    def trained_airs(self) -> Real:
        """AIR of decoders that are trained where a re-fit is not enough, bits a symbol, [N]."""
        anew, air = self.airs("anew"), self.airs("air")
        enough = air >= air[np.argmin(np.abs(self.values - self.at))] - LOSS
        return np.where(np.isnan(anew) & enough, air, anew)

    def within(self, name: str) -> Range | None:
        """Return the values that lose at most `LOSS` against the trained device; None if only that one was measured."""
        if not self.measured(name):
            return None
        airs = self.trained_airs if name == "anew" else self.airs(name)
        known = np.isfinite(airs)
        values, airs, at = self.values[known], airs[known], self.at
        least = float(airs[np.argmin(np.abs(values - at))]) - LOSS
        if not self.knob.logarithmic:
            return Range.of(values, airs, at, least)
        found = Range.of(np.log(values), airs, math.log(at), least)
        return Range(math.exp(found.low), math.exp(found.high), found.below, found.above)


def _curves(cases: Sequence[Case], results: Sequence[Result]) -> list[_Curve]:
    trained, curves = {**results[0], "anew": results[0]["air"]}, list[_Curve]()
    for name, knob in KNOBS.items():
        own = [(case, result) for case, result in zip(cases, results, strict=True) if case.get("knob") == name]
        if own:
            at = own[0][0]["at"]
            points: dict[float, Result] = {at: trained, **{case["value"]: result for case, result in own}}
            values = sorted(points)
            curves.append(_Curve(knob, at, np.array(values), [points[value] for value in values]))
    return curves


def _rows(cases: Sequence[Case], results: Sequence[Result]) -> list[Row]:
    air, told = (f"{results[0][name]:.2f} bits" for name in ("air", "told"))
    rows: list[Row] = [("the device that was trained on", "", "", air, "", told, "")]
    for curve in _curves(cases, results):
        knob, within = curve.knob, {name: curve.within(name) for name in ("air", "told", "anew")}
        least = 0.0 if knob.values[0] >= 0 else None
        texts = {name: "-" if found is None else found.text(1.0, least) for name, found in within.items()}
        full = ""
        if knob.full_size is not None and within["air"] is not None:
            factor, unit = knob.full_size
            full = f"{within['air'].text(factor, least)} {unit}"
        rows.append((knob.title, knob.unit, curve.at, texts["air"], full, texts["told"], texts["anew"]))
    return rows


def _plot(settings: Settings, cases: Sequence[Case], results: Sequence[Result]) -> Figure:
    curves = _curves(cases, results)
    columns = min(_COLUMNS, max(1, len(curves)))
    lines = max(1, math.ceil(len(curves) / columns))
    figure = Figure(figsize=(3.1 * columns + 0.4, 2.5 * lines + 0.7), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False, sharey=True)
    for axis, curve in zip(axes.flat, curves, strict=False):
        _draw(axis, curve)
    axes[0, 0].invert_yaxis()  # of all: up is better
    for axis in axes.flat[len(curves) :]:
        axis.set_visible(False)
    for row in axes:
        row[0].set_ylabel("AIR lost, bits a symbol")
    named = {
        label: handle for axis in axes.flat for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    columns = min(columns + 1, len(_CURVES) + 3)
    figure.legend(named.values(), named.keys(), loc="outside upper center", ncols=columns, fontsize="small")
    return figure


def _draw(axis: Axes, curve: _Curve) -> None:
    """Draw what a knob's values cost of the AIR, the range shaded within which that is no more than `LOSS`."""
    trained = int(np.argmin(np.abs(curve.values - curve.at)))
    within = curve.within("air")
    if within is not None:
        axis.axvspan(within.low, within.high, color="tab:blue", alpha=0.12, label=f"at most {LOSS:g} bit lost")
    for name, (label, style, colour) in _CURVES.items():
        if not curve.measured(name):
            continue
        lost = curve.airs("air")[trained] - curve.airs(name)
        axis.plot(curve.values, lost, style, color=colour, markersize=4, linewidth=1.2, label=label)
    axis.axhline(LOSS, color="tab:red", linestyle="--", linewidth=0.8, label=f"{LOSS:g} bit")
    axis.axvline(curve.at, color="0.6", linestyle=":", linewidth=1, label="trained at")
    if curve.knob.logarithmic:
        axis.set_xscale("log")
    else:
        axis.locator_params(axis="x", nbins=_TICKS)
    axis.set_title(textwrap.fill(curve.knob.title, _TITLE), fontsize="small")
    axis.set_xlabel(curve.knob.unit, fontsize="small")
    axis.set_yscale("symlog", linthresh=LOSS)
    axis.set_yticks(_LOSSES, [f"{loss:g}" for loss in _LOSSES])
    axis.minorticks_off()
    axis.tick_params(labelsize="small")


STUDY = Study(
    title=f"how far each knob of a device may be off: within which range {LOSS:g} bit a symbol is lost",
    source="beyond the paper",
    cases=_cases,
    measure=_measure,
    header=("knob", "unit", "trained at", "re-fitted", "at full size", "told", "trained anew"),
    rows=_rows,
    plot=_plot,
    parts=True,
)
