"""What every GenICam camera is asked for, whichever driver asks; names are those of the SFNC."""

from __future__ import annotations

from collections.abc import Iterable

FRAME_SELECTORS = ("FrameStart", "FrameBurstStart")
"""Triggers that start a frame, the better one first."""
OTHER_SELECTORS = ("AcquisitionStart", "AcquisitionEnd", "FrameEnd", "FrameActive", "ExposureStart", "LineStart")
SWITCHED_OFF = ("ChunkModeActive", "AcquisitionFrameRateEnable")
AUTOMATIC = ("ExposureAuto", "GainAuto", "BlackLevelAuto")
"""What a camera would change by itself."""

KEYS = {
    "PixelFormat": "pixel_format",
    "TriggerSource": "trigger_source",
    "TriggerActivation": "trigger_activation",
    "Width": "columns of the profile's camera",
    "Height": "rows of the profile's camera",
    "OffsetX": "offset_x_px",
    "OffsetY": "offset_y_px",
    "region": "region by the profile's camera, offset_x_px, offset_y_px",
    **{key: key for key in ("exposure_us", "gain_db", "black_level_counts")},
}
"""What is set because a key says so: the key, for errors."""

EXPOSURE_TOLERANCE = 0.05
"""Relative: cameras expose for whole lines of the sensor."""
GAIN_TOLERANCE_DB = 0.1
BLACK_LEVEL_TOLERANCE = 0.5

QUIET_S = 0.02
"""No frame for so long after the start: those from before are out."""
MOST_DRAINING_S = 0.5
"""A trigger that never rests is not waited for any longer."""
SIGN_OF_LIFE_S = 0.05
"""A camera that sends no frame for so long is asked whether it is there."""


def describe_region(x: int, y: int, columns: int, rows: int) -> str:
    """A region of interest, for people."""
    return f"{columns} x {rows} pixels at ({x}, {y})"


def one_of(entries: Iterable[str]) -> str:
    """What a camera offers, for people; empty if nothing."""
    return f"one of {told}" if (told := ", ".join(entries)) else ""


def between(least: float, most: float) -> str:
    """The same of a number."""
    return f"{least:.10g} to {most:.10g}"


def asked_for(value: object, kept: object = None) -> str:
    """What a camera was asked for, and what it made of it, where it refused nothing."""
    return str(value) if kept is None else f"{value}, of which the camera makes {kept}"


def frame_numbers(is_gige: bool, extended_ids: bool) -> int:
    """The largest number of a frame: 16 bits of a GigE camera without extended block ids, else 64."""
    return 2**16 - 1 if is_gige and not extended_ids else 2**64 - 1
