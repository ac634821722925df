"""Drift of a device over the pages of a recording, whose order is taken as time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.runtime.model.decoding.image_position import ImagePosition
from lightpage.runtime.model.decoding.page import DecodedPage

Real = NDArray[np.float64]


class PageState(NamedTuple):
    """State of a device as one page shows it; NaN where it does not.

    Attributes:
        piston_rad: phase of the signal against the reference.
        image_x_px, image_y_px: shift of the image since calibration, camera pixels.
        tilt_x_rad, tilt_y_rad: tilt of the signal against the reference since calibration, at the image's edges.
        stroke_relative: stroke of the modulator beyond its calibration.
        brightness_relative: power of the light over that of the calibration's pages.
    """

    piston_rad: float
    image_x_px: float
    image_y_px: float
    tilt_x_rad: float
    tilt_y_rad: float
    stroke_relative: float
    brightness_relative: float

    @classmethod
    def of(cls, page: DecodedPage) -> PageState:
        """Return the state that a decoded page shows."""
        nan = float("nan")
        image = page.image or ImagePosition(nan, nan, nan, nan)
        return cls(
            piston_rad=page.piston_rad,
            image_x_px=image.shift_x_px,
            image_y_px=image.shift_y_px,
            tilt_x_rad=image.tilt_x_rad,
            tilt_y_rad=image.tilt_y_rad,
            stroke_relative=page.stroke_relative,
            brightness_relative=page.brightness,
        )


@dataclass(frozen=True)
class Drift:
    """Drift of one quantity.

    Attributes:
        values: its value on each page, that of the piston unwrapped; None where a page does not show it.
        step: root mean square of its change from a page to the next that was read.
        range: difference between its largest and its smallest value.
    """

    values: tuple[float | None, ...]
    step: float
    range: float


def drift_of(states: Sequence[PageState]) -> dict[str, Drift]:
    """Drift of each quantity that at least two pages show, by the name of its field in `PageState`."""
    drifts: dict[str, Drift] = {}
    for name in PageState._fields:
        values = np.array([getattr(state, name) for state in states], np.float64)
        shown = np.isfinite(values)
        if np.count_nonzero(shown) < 2:
            continue
        if name == "piston_rad":
            values[shown] = np.unwrap(values[shown])
        own = values[shown]
        drifts[name] = Drift(
            values=tuple(float(value) if np.isfinite(value) else None for value in values),
            step=float(np.sqrt(np.mean(np.diff(own) ** 2))),
            range=float(np.ptp(own)),
        )
    return drifts


def steps_of(drifts: Mapping[str, Drift]) -> dict[str, float]:
    """Step from page to page of each quantity, by its name."""
    return {name: drift.step for name, drift in drifts.items()}


def described(steps: Mapping[str, float]) -> str:
    """Steps from page to page in words; empty where no drift is known."""
    parts = []
    for name, step in steps.items():
        what, _, unit = name.rpartition("_")
        shown = "" if unit == "relative" else f" {unit}"
        parts.append(f"{what.replace('_', ' ')} {step:.2g}{shown}")
    return ", ".join(parts)


def pages_until(drifts: dict[str, Drift], distance_px: float) -> int | None:
    """Pages after which a random walk of the image has gone so far, root mean square; None where it does not move."""
    steps = [drifts[name].step for name in ("image_x_px", "image_y_px") if name in drifts]
    walked = float(np.sum(np.square(steps)))
    return round(distance_px**2 / walked) if walked > 0 else None
