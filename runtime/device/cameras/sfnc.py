"""What every GenICam camera is asked for, whichever driver asks; names are those of the SFNC."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable

from lightpage.runtime.device.cameras.settings import CameraSettings

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

QUIET_S = 0.02
"""No frame for so long after the start: those from before are out."""
MOST_DRAINING_S = 0.5
"""A trigger that never rests is not waited for any longer."""
SIGN_OF_LIFE_S = 0.05
"""A camera that sends no frame for so long is asked whether it is there."""


def tolerance(key: str, value: float) -> float:
    """Return how much a number that is read back may differ; a camera exposes for whole lines of its sensor."""
    return {"exposure_us": 0.05 * value, "gain_db": 0.1, "black_level_counts": 0.5}.get(key, 0.0)


def trigger_features(settings: CameraSettings, selectors: Collection[str], knows_activation: bool) -> dict[str, str]:
    """What a trigger is set to, in this order.

    Args:
        settings: of the camera.
        selectors: triggers that it has.
        knows_activation: a command has no edges, and a camera that knows none is taken at its word unless another one
            than the usual is wanted.
    """
    selector = next((name for name in FRAME_SELECTORS if name in selectors), None)
    wanted = {} if selector is None else {"TriggerSelector": selector}
    wanted["TriggerSource"] = settings.trigger_source
    if settings.trigger_source != "Software" and (settings.trigger_activation != "RisingEdge" or knows_activation):
        wanted["TriggerActivation"] = settings.trigger_activation
    return {**wanted, "TriggerMode": "On"}


def refusal(
    setting: str, asked: object, kept: object, told: str, offers: Callable[[], str]
) -> tuple[str, object, object]:
    """What an error says of a setting: subject, what came and what was wanted; by its key, where a key says so.

    Args:
        setting: its feature, or its key.
        asked: what the camera was asked for.
        kept: what it made of that, or None where it refused.
        told: why it refused.
        offers: what it takes, for people; empty where it does not say.
    """
    if setting not in KEYS:
        return setting, told if kept is None else kept, asked
    got = asked if kept is None else f"{asked}, of which the camera makes {kept}"
    return KEYS[setting], got, offers() or f"what the camera knows{f' ({told})' if told else ''}"


def describe_region(x: int, y: int, columns: int, rows: int) -> str:
    """A region of interest, for people."""
    return f"{columns} x {rows} pixels at ({x}, {y})"


def one_of(entries: Iterable[str]) -> str:
    """What a camera offers, for people; empty if nothing."""
    return f"one of {told}" if (told := ", ".join(entries)) else ""


def between(least: float, most: float) -> str:
    """The same of a number."""
    return f"{least:.10g} to {most:.10g}"


def frame_numbers(is_gige: bool, extended_ids: bool) -> int:
    """The largest number of a frame: 16 bits of a GigE camera without extended block ids, else 64."""
    return 2**16 - 1 if is_gige and not extended_ids else 2**64 - 1
