"""Results of a calibration for people, and for other programs."""

from __future__ import annotations

import math
import textwrap

import numpy as np

from lightpage.calibration.coherence import seen_share
from lightpage.calibration.document import Calibration
from lightpage.calibration.interfaces import Twin
from lightpage.calibration.parameters import NAMES, PRIORS, indices
from lightpage.calibration.waves.wave_model import axial_place_m
from lightpage.device.profile import Profile
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.twin import OnnxTwin


def symbols_beside_cameras(decoder: Decoder | None, calibration: Calibration, profile: Profile) -> int:
    """Count the symbols most of whose light misses a camera."""
    twin: Twin
    if decoder is not None:
        twin = OnnxTwin(decoder.bundle)
    else:
        from lightpage.train.trainers.calibration import nominal_twin

        twin = nominal_twin(profile)
    return int(np.sum(seen_share(twin, calibration.vector, profile) < 0.5))


def figures(calibration: Calibration, profile: Profile, seconds: float, lost: int) -> dict[str, object]:
    """The result under the names that other programs read; `lost` symbols have most of their light beside a camera."""
    return {
        "angle_deg": calibration.angle_deg(profile),
        "pages_used": calibration.pages_used,
        "seconds": seconds,
        "coherence_before": calibration.coherence_before,
        "coherence_after": calibration.coherence_after,
        "turn_deg": float(np.rad2deg(calibration.turn_rad)),
        "turn_deviation_deg": calibration.turn_deviation_rad and math.degrees(calibration.turn_deviation_rad),
        "parameters": calibration.parameters,
        "axial_mm": {
            name.removesuffix("_axial_rad"): 1e3 * axial_place_m(calibration.parameters[name], profile)
            for name in _AXIAL
        },
        "modulation": calibration.modulation,
        "symbols_beside_cameras": lost,
        "goodness": None if calibration.goodness is None else calibration.goodness.model_dump(),
        "reading": None if calibration.reading is None else calibration.reading.model_dump(),
        "blemishes": None if calibration.blemishes is None else calibration.blemishes.model_dump(),
    }


def losses(calibration: Calibration) -> str:
    """Causes of what is lost with their bits and remedies, for people; empty where none was found."""
    causes = () if calibration.goodness is None else calibration.goodness.causes
    if not causes:
        return ""
    lines = ["lost, bits a symbol, estimated:"]
    for cause in causes:
        for first, text in ((f"{cause.bits:>8.3f}  ", cause.what), (f"{'':>10}remedy: ", cause.remedy)):
            lines += textwrap.wrap(text, _COLUMNS, initial_indent=first, subsequent_indent=f"{'':>10}")
    return "\n".join(lines)


_COLUMNS = 118
_AXIAL = tuple(NAMES[index] for index in indices("axial"))
_UNITS = frozenset({"m", "rad", "px", "deg", "relative"})


def _label(name: str) -> str:
    """Return the name of a parameter for people, with its unit behind a comma."""
    stem, _, unit = name.rpartition("_")
    return f"{stem.replace('_', ' ')}, {unit}" if unit in _UNITS else name.replace("_", " ")


def table(calibration: Calibration, profile: Profile) -> str:
    """Fitted values with standard deviations, beside nominal ones and usual differences from these, for people."""
    shown = {
        "pipe_angle_rad": ("pipe angle, degree", profile.pipe.angle_deg, 180 / np.pi),
        "focal_length_relative": ("focal length, mm", 1e3 * profile.lens.focal_length_m, None),
        "pipe_length_relative": ("pipe length, mm", 1e3 * profile.pipe.length_m, None),
        "pipe_width_relative": ("pipe width, mm", 1e3 * profile.pipe.width_m, None),
    }
    lines = [f"{'':<32}{'fitted':>12}   {'+-':<10}{'nominal':>10}   {'usual +-':<10}"]
    for name, value in calibration.parameters.items():
        if name not in calibration.fitted:
            continue
        label, nominal, unit = shown.get(name, (_label(name), 0.0, 1.0))
        factor = nominal if unit is None else unit
        fitted = nominal + factor * value
        deviation = factor * calibration.deviations[name]
        usual = factor * PRIORS[NAMES.index(name)]
        line = f"{label:<32}{fitted:>12.6g}   {deviation:<10.2g}{nominal:>10.6g}   {usual:<10.2g}"
        axial = f"{1e3 * axial_place_m(value, profile):+.3g} mm from its focal plane" if name in _AXIAL else ""
        lines.append(f"{line}{axial}".rstrip())
    for name, value in calibration.modulation.items():
        lines.append(f"{_label(name):<32}{value:>12.6g}   {calibration.modulation_deviations[name]:<10.2g}{0:>10.6g}")
    turn = math.degrees(calibration.turn_rad)
    deviation_rad = calibration.turn_deviation_rad
    turn_deviation = "" if deviation_rad is None else f"{math.degrees(deviation_rad):.2g}"
    lines.append(f"{'between the arms, degree':<32}{turn:>12.6g}   {turn_deviation:<10}{'+90 or -90':>10}")
    return "\n".join(lines)
