"""The settings that every GenICam camera gets, whichever driver gives them; features have their names of the SFNC."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from lightpage.errors import SourceError
from lightpage.runtime.device.cameras.pixel_formats import pixel_format
from lightpage.runtime.device.cameras.settings import CameraSettings

FRAME_SELECTORS = ("FrameStart", "FrameBurstStart")
"""Triggers that start a frame, the better one first."""
OTHER_SELECTORS = ("AcquisitionStart", "AcquisitionEnd", "FrameEnd", "FrameActive", "ExposureStart", "LineStart")
SWITCHED_OFF = ("ChunkModeActive", "AcquisitionFrameRateEnable")
AUTOMATIC = ("ExposureAuto", "GainAuto", "BlackLevelAuto")
"""What a camera would change by itself."""
_TOLERANCES = {"exposure_us": 0.05, "gain_db": 0.1, "black_level_counts": 0.5}
"""Numbers that are set, and how much one that is read back may differ: of the exposure time a share, for a camera
exposes for whole lines of its sensor."""

KEYS = {
    "PixelFormat": "pixel_format",
    "TriggerSource": "trigger_source",
    "TriggerActivation": "trigger_activation",
    "Width": "columns of the profile's camera",
    "Height": "rows of the profile's camera",
    "OffsetX": "offset_x_px",
    "OffsetY": "offset_y_px",
    "region": "region by the profile's camera, offset_x_px, offset_y_px",
    **{key: key for key in _TOLERANCES},
}
"""What is set because a key says so: the key, for errors."""

QUIET_S = 0.02
"""No frame for so long after the start: those from before are out."""
MOST_DRAINING_S = 0.5
"""A trigger that never rests is not waited for any longer."""
SIGN_OF_LIFE_S = 0.05
"""A camera that sends no frame for so long is asked whether it is there."""


class Region(NamedTuple):
    """A region of interest, pixels of the sensor."""

    x: int
    y: int
    columns: int
    rows: int

    def __str__(self) -> str:
        return f"{self.columns} x {self.rows} pixels at ({self.x}, {self.y})"


class CameraSetup(ABC):
    """Gives one open camera its settings, and reads them back: cameras round, clip and ignore what they get.

    A driver reads and writes what goes by the name of a feature, or of a key of `CameraSettings` for a number.
    One thread at a time uses it.

    Args:
        settings: what it is to be set to.
        frame_shape: (rows, columns) of the region that is read.
        name: name of the camera, for errors.
        is_gige: whether it is a GigE camera.

    Every method raises `SourceError` where the camera does not take a setting, and the driver's error where it is gone.
    """

    refusals: tuple[type[Exception], ...]
    """What a driver raises where a camera refuses."""

    def __init__(self, settings: CameraSettings, frame_shape: tuple[int, int], name: str, is_gige: bool) -> None:
        self.settings, self.frame_shape, self.name, self.is_gige = settings, frame_shape, name, is_gige
        rows, columns = frame_shape
        self.region = Region(settings.offset_x_px, settings.offset_y_px, columns, rows)
        self._set: dict[str, Any] = {}
        """What was set, in its order."""

    @abstractmethod
    def has(self, feature: str) -> bool:
        """Return whether the camera has a feature now."""

    @abstractmethod
    def entries(self, feature: str) -> list[str]:
        """Return what a feature that it has can be set to."""

    @abstractmethod
    def write(self, feature: str, value: Any) -> None:
        """Set a feature."""

    @abstractmethod
    def read(self, feature: str, kind: type) -> Any:
        """Return what the camera itself says of a feature that was set to a value of this kind."""

    @abstractmethod
    def limits(self, feature: str) -> str:
        """Return what a feature that is a number, or the region, can be set to, for people."""

    @abstractmethod
    def told(self, error: Exception) -> str:
        """Why the camera refuses, for people; raises an error that says that it has gone."""

    def set_image(self) -> None:
        """Set all that a frame depends on but its trigger, which is switched off."""
        for selector in self._selectors() or [""]:
            if selector:
                self.set("TriggerSelector", selector)
            self.set("TriggerMode", "Off")
        self.set("AcquisitionMode", "Continuous")
        for feature, off in {**dict.fromkeys(SWITCHED_OFF, False), **dict.fromkeys(AUTOMATIC, "Off")}.items():
            if self.has(feature):
                self.set(feature, off)
        self.set("PixelFormat", self.settings.pixel_format)
        self.set_region()
        for key in _TOLERANCES:
            value = getattr(self.settings, key)
            if value is not None and (key in self.settings.model_fields_set or self.has(key)):
                self.set(key, value)

    def set_region(self) -> None:
        """Set the region that is read."""
        self.set("region", self.region)

    def set_trigger(self) -> None:
        """Set the trigger; last of all, for some settings switch it off again.

        A command has no edges. A camera that knows none is taken at its word unless another than the usual is wanted.
        """
        settings, selectors = self.settings, self._selectors()
        if selector := next((name for name in FRAME_SELECTORS if name in selectors), None):
            self.set("TriggerSelector", selector)
        self.set("TriggerSource", settings.trigger_source)
        unusual = settings.trigger_activation != "RisingEdge"
        if settings.trigger_source != "Software" and (unusual or self.has("TriggerActivation")):
            self.set("TriggerActivation", settings.trigger_activation)
        self.set("TriggerMode", "On")

    def set(self, feature: str, value: Any) -> None:
        """Set a feature; `check` reads it back."""
        with self.setting(feature, value):
            self.write(feature, value)
        self._set[feature] = value

    def payload(self) -> int:
        """Bytes of a frame: its pixels, and whatever the camera adds to them."""
        least = pixel_format(self.settings.pixel_format).nbytes(self.region.rows * self.region.columns)
        with self.setting("PayloadSize", least):
            payload = int(self.read("PayloadSize", int))
        if payload < least:
            raise self._refused("PayloadSize", f"{least} or more", payload)
        return payload

    def check(self) -> float | None:
        """Read everything back; returns the exposure time that the camera keeps, in seconds, where it knows one."""
        exposure_s = None
        for feature, value in self._set.items():
            if feature == "TriggerSelector":
                continue  # it says only which trigger the others are of; a camera may go back to its own
            with self.setting(feature, value):
                got = self.read(feature, type(value))
            scale = value if feature == "exposure_us" else 1
            if abs(got - value) > _TOLERANCES[feature] * scale if feature in _TOLERANCES else got != value:
                raise self._refused(feature, value, got)
            if feature == "exposure_us":
                exposure_s = 1e-6 * float(got)
        return exposure_s

    def frame_numbers(self) -> int:
        """The largest number of a frame: 16 bits of a GigE camera without extended block ids, else 64."""
        extended = self.has("GevGVSPExtendedIDMode") and self.read("GevGVSPExtendedIDMode", str) == "On"
        return 2**16 - 1 if self.is_gige and not extended else 2**64 - 1

    @contextmanager
    def setting(self, setting: str, expected: object) -> Iterator[None]:
        """Name the setting that the camera refuses."""
        try:
            yield
        except self.refusals as error:
            raise self._refused(setting, expected, None, self.told(error)) from None

    def _selectors(self) -> list[str]:
        """Triggers that it has, those that start a frame last."""
        if not self.has("TriggerSelector"):
            return []
        known = self.entries("TriggerSelector")
        return [name for name in (*OTHER_SELECTORS, *FRAME_SELECTORS) if name in known]

    def _refused(self, setting: str, asked: object, kept: object, told: str = "") -> SourceError:
        """The error of a setting: by its key, where a key says so.

        Args:
            setting: its feature, or its key.
            asked: what the camera was asked for.
            kept: what it made of that, or None where it refused.
            told: why it refused.
        """
        subject = f"{self.name}: {KEYS.get(setting, setting)}"
        if setting not in KEYS:
            return SourceError(subject, told if kept is None else kept, asked)
        got = asked if kept is None else f"{asked}, of which the camera makes {kept}"
        expected = self._offers(setting) or f"what the camera knows{f' ({told})' if told else ''}"
        return SourceError(subject, got, expected)

    def _offers(self, setting: str) -> str:
        """Return what the camera takes, for people; empty where it does not say."""
        try:
            if setting in ("PixelFormat", "TriggerSource", "TriggerActivation"):
                return f"one of {told}" if (told := ", ".join(self.entries(setting))) else ""
            return self.limits(setting)
        except self.refusals:
            return ""


def between(least: float, most: float) -> str:
    """Limits of a number, for people."""
    return f"{least:.10g} to {most:.10g}, in its steps"
