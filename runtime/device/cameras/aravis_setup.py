"""Gives a camera its settings over Aravis, and reads each one back: cameras round, clip and ignore what they get."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import byref, c_double, c_int, c_uint32
from dataclasses import dataclass
from typing import Any

from lightpage.errors import SourceError
from lightpage.runtime.device.cameras.aravis_connection import AravisConnection, says_gone
from lightpage.runtime.device.cameras.aravis_library import RANGE_CHECK_ENABLE, SOCKET_BUFFER_AUTO, AravisError, aravis
from lightpage.runtime.device.cameras.gige_network import route_mtu
from lightpage.runtime.device.cameras.pixel_formats import pixel_format
from lightpage.runtime.device.cameras.settings import CameraSettings
from lightpage.runtime.device.cameras.sfnc import (
    AUTOMATIC,
    BLACK_LEVEL_TOLERANCE,
    EXPOSURE_TOLERANCE,
    FRAME_SELECTORS,
    GAIN_TOLERANCE_DB,
    KEYS,
    OTHER_SELECTORS,
    SWITCHED_OFF,
    asked_for,
    between,
    describe_region,
    frame_numbers,
    one_of,
)

_BOUNDS = {"exposure_us": "exposure_time", "gain_db": "gain", "black_level_counts": "black_level"}
"""What the library calls the limits of a number."""


@dataclass
class AravisSetup:
    """The settings of one camera that is open. One thread at a time uses it.

    Args:
        connection: the camera.
        settings: what it is to be set to.
        frame_shape: (rows, columns) of the region that is read.
        name: of the camera, for errors.

    Every method raises `SourceError` where the camera does not take a setting, and `AravisError` where it is gone.
    """

    connection: AravisConnection
    settings: CameraSettings
    frame_shape: tuple[int, int]
    name: str

    def __post_init__(self) -> None:
        self._library, self._camera = aravis(), self.connection.handle
        self._packet_bytes = 0

    def stop(self) -> None:
        """Stop the acquisition, whoever started it: cameras lock settings during one."""
        with self._setting("acquisition", "stopped"):
            self._do("stop_acquisition")

    def set_image(self) -> None:
        """Set all that a frame depends on but its trigger, which is switched off."""
        settings = self.settings
        self._do("set_range_check_policy", RANGE_CHECK_ENABLE)
        for selector in (*OTHER_SELECTORS, *FRAME_SELECTORS):
            if self._has_entry("TriggerSelector", selector):
                self._set_string("TriggerSelector", selector)
                self._set_string("TriggerMode", "Off")
        self._set_string("AcquisitionMode", "Continuous")
        for feature in SWITCHED_OFF:
            if self._has(feature):
                with self._setting(feature, "off"):
                    self._do("set_boolean", feature.encode(), 0)
        for feature in AUTOMATIC:
            if self._has(feature):
                self._set_string(feature, "Off")
        rows, columns = self.frame_shape
        self._set_string("PixelFormat", settings.pixel_format)
        with self._setting("region", self._region()):
            self._do("set_region", settings.offset_x_px, settings.offset_y_px, columns, rows)
        with self._setting("exposure_us", settings.exposure_us):
            self._do("set_exposure_time", settings.exposure_us)
        if settings.gain_db is not None:
            with self._setting("gain_db", settings.gain_db):
                self._do("set_gain", settings.gain_db)
        if settings.black_level_counts is not None:
            with self._setting("black_level_counts", settings.black_level_counts):
                self._do("set_black_level", settings.black_level_counts)
        if self.connection.is_gige:
            self._set_packets()

    def _set_packets(self) -> None:
        """The size of packets: as asked for, as large as test packets get through, or as the network card takes."""
        with self._setting("packet_bytes", self.settings.packet_bytes or "one that gets through"):
            if self.settings.packet_bytes is not None:
                self._packet_bytes = self.settings.packet_bytes
            elif self._has("GevSCPSFireTestPacket"):
                self._packet_bytes = self._do("gv_auto_packet_size")
                return
            else:
                self._packet_bytes = route_mtu(self.connection.address)
            self._do("gv_set_packet_size", self._packet_bytes)

    def make_stream(self, payload: int) -> int:
        """A stream with empty buffers of `payload` bytes; it ends when it is let go of."""
        with self._setting("stream", "one"):
            stream: int = self._do("create_stream", None, None, None)
        if self.connection.is_gige:
            self._library.set_property(stream, "socket-buffer", SOCKET_BUFFER_AUTO)
        for _ in range(self.settings.buffers):
            self._library("arv_stream_push_buffer", stream, self._library("arv_buffer_new_allocate", payload))
        return stream

    def payload(self) -> int:
        """Bytes of a frame: its pixels, and whatever the camera adds to them."""
        rows, columns = self.frame_shape
        expected = pixel_format(self.settings.pixel_format).nbytes(rows * columns)
        with self._setting("PayloadSize", expected):
            payload: int = self._do("get_payload")
        if payload < expected:
            self._compare("PayloadSize", payload, f"{expected} or more")
        return payload

    def set_trigger(self) -> None:
        """Set the trigger; last of all, for some settings switch it off again."""
        settings = self.settings
        selector = next((name for name in FRAME_SELECTORS if self._has_entry("TriggerSelector", name)), None)
        if selector is not None:
            self._set_string("TriggerSelector", selector)
        self._set_string("TriggerSource", settings.trigger_source)
        if self._uses_activation():
            self._set_string("TriggerActivation", settings.trigger_activation)
        self._set_string("TriggerMode", "On")

    def check(self) -> float:
        """Read everything back; returns the exposure time that the camera keeps, in seconds."""
        settings = self.settings
        wanted = {
            "TriggerMode": "On",
            "TriggerSource": settings.trigger_source,
            "AcquisitionMode": "Continuous",
            "PixelFormat": settings.pixel_format,
        }
        if self._uses_activation():
            wanted["TriggerActivation"] = settings.trigger_activation
        for feature, expected in wanted.items():
            with self._setting(feature, expected):
                got = self._do("get_string", feature.encode())
            self._compare(feature, (got or b"").decode("utf-8", "replace"), expected)
        corners = [c_int() for _ in range(4)]
        with self._setting("region", self._region()):
            self._do("get_region", *map(byref, corners))
        x, y, columns, rows = (corner.value for corner in corners)
        self._compare("region", describe_region(x, y, columns, rows), self._region())
        if self.connection.is_gige:
            with self._setting("packet_bytes", self._packet_bytes):
                got = self._do("gv_get_packet_size")
            self._compare("packet_bytes", got, self._packet_bytes)
        if settings.gain_db is not None:
            self._check_number("gain_db", "get_gain", settings.gain_db, GAIN_TOLERANCE_DB)
        if settings.black_level_counts is not None:
            level = settings.black_level_counts
            self._check_number("black_level_counts", "get_black_level", level, BLACK_LEVEL_TOLERANCE)
        tolerance = EXPOSURE_TOLERANCE * settings.exposure_us
        return 1e-6 * self._check_number("exposure_us", "get_exposure_time", settings.exposure_us, tolerance)

    @property
    def packet_bytes(self) -> int:
        """Size of a GigE packet, headers included; 0 before it is chosen, and of other cameras."""
        return self._packet_bytes

    def frame_numbers(self) -> int:
        """See `sfnc.frame_numbers`."""
        extended = self._has("GevGVSPExtendedIDMode") and self._do("get_string", b"GevGVSPExtendedIDMode") == b"On"
        return frame_numbers(self.connection.is_gige, extended)

    def start(self) -> None:
        """Start the acquisition; from here on a trigger makes a frame."""
        with self._setting("acquisition", "started"):
            self._do("start_acquisition")

    def _do(self, what: str, *arguments: Any) -> Any:
        return self._library(f"arv_camera_{what}", self._camera, *arguments)

    def _has(self, feature: str) -> bool:
        return bool(self._do("is_feature_available", feature.encode()))

    def _has_entry(self, feature: str, entry: str) -> bool:
        return self._has(feature) and bool(self._do("is_enumeration_entry_available", feature.encode(), entry.encode()))

    def _uses_activation(self) -> bool:
        """A command has no edges, and a camera that knows none is taken at its word unless another one is wanted."""
        if self.settings.trigger_source == "Software":
            return False
        return self.settings.trigger_activation != "RisingEdge" or self._has("TriggerActivation")

    def _set_string(self, feature: str, value: str) -> None:
        with self._setting(feature, value):
            self._do("set_string", feature.encode(), value.encode())

    def _check_number(self, setting: str, getter: str, expected: float, tolerance: float) -> float:
        with self._setting(setting, expected):
            got = float(self._do(getter))
        if abs(got - expected) > tolerance:
            self._compare(setting, got, expected)
        return got

    def _compare(self, setting: str, got: object, expected: object) -> None:
        if got != expected:
            raise self._refused(setting, expected, got, "")

    def _region(self) -> str:
        rows, columns = self.frame_shape
        return describe_region(self.settings.offset_x_px, self.settings.offset_y_px, columns, rows)

    @contextmanager
    def _setting(self, setting: str, expected: object) -> Iterator[None]:
        """Name the setting that the camera refuses."""
        try:
            yield
        except AravisError as error:
            if says_gone(error):
                raise
            raise self._refused(setting, expected, None, error.message) from None

    def _refused(self, setting: str, asked: object, kept: object, told: str) -> SourceError:
        """The error of a setting: by its key, where a key says so, with what the camera offers."""
        if setting not in KEYS:
            return SourceError(f"{self.name}: {setting}", told if kept is None else kept, asked)
        try:
            offers = self._offers(setting)
        except AravisError:
            offers = ""
        expected = offers or f"what the camera knows{f' ({told})' if told else ''}"
        return SourceError(f"{self.name}: {KEYS[setting]}", asked_for(asked, kept), expected)

    def _offers(self, setting: str) -> str:
        if setting == "region":
            sides = [c_int(), c_int()]
            self._do("get_sensor_size", *map(byref, sides))
            return f"a region of its sensor, {sides[0].value} x {sides[1].value} pixels, in its steps"
        if setting in _BOUNDS:
            limits = [c_double(), c_double()]
            self._do(f"get_{_BOUNDS[setting]}_bounds", *map(byref, limits))
            return f"{between(*(limit.value for limit in limits))}, in its steps"
        count = c_uint32()
        entries = self._do("dup_available_enumerations_as_strings", setting.encode(), byref(count))
        return one_of(entries[number].decode("utf-8", "replace") for number in range(count.value))
