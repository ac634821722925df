"""One camera under Aravis: found, opened and given its settings, until it is let go of or has gone away.

Each setting is read back: cameras round, clip and ignore what they get.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import byref, c_double, c_int, c_uint32
from dataclasses import dataclass
from typing import Any

from lightpage.errors import SourceError
from lightpage.runtime.device.cameras import sfnc
from lightpage.runtime.device.cameras.aravis_library import (
    RANGE_CHECK_ENABLE,
    SIGNAL,
    SOCKET_BUFFER_AUTO,
    AravisError,
    AravisLibrary,
    aravis,
)
from lightpage.runtime.device.cameras.gige_network import CONTROL_PRIVILEGE, read_register, route_mtu
from lightpage.runtime.device.cameras.pixel_formats import pixel_format
from lightpage.runtime.device.cameras.settings import CameraSettings

_DEVICE_ERRORS = "arv-device-error-quark"
_GONE = {2, 4, 5}
"""Not connected, transfer error, timeout: no answer. Whoever refuses is there."""
_NUMBERS = {"exposure_us": "exposure_time", "gain_db": "gain", "black_level_counts": "black_level"}
"""What the library calls the keys of numbers."""


def says_gone(error: AravisError) -> bool:
    """Whether the library means that the camera does not answer."""
    return error.domain == _DEVICE_ERRORS and error.code in _GONE


class AravisConnection:
    """A camera under this program's control. One thread at a time uses it.

    Args:
        settings: which camera.
        name: of the camera, for errors.
        known: whether it was open before. If one with an address is gone, then nobody looks for what else is there.

    Attributes:
        handle: of the ArvCamera.
        is_gige: whether it is a GigE camera.
        serial: its number.
        address: of a GigE camera, else empty.

    Raises:
        SourceError: no library, no such camera, or another program controls it.
        AravisError: it went away meanwhile.
    """

    def __init__(self, settings: CameraSettings, name: str, known: bool = False) -> None:
        self._library = library = aravis()
        device_id, self.address = _locate(library, settings, name, known)
        self.handle: int = library("arv_camera_new", device_id.encode())
        try:
            self._device: int = library("arv_camera_get_device", self.handle)
            self.is_gige = bool(library("arv_camera_is_gv_device", self.handle))
            if self.is_gige and not library("arv_gv_device_is_controller", self._device):
                raise SourceError(name, "another program that controls it", "the only one")
            number = library.text("arv_camera_get_device_serial_number", self.handle)
            self.serial = settings.serial or number or device_id
        except BaseException:
            library.unref(self.handle)
            raise
        self._lost = threading.Event()
        self._on_lost = SIGNAL(lambda *_: self._lost.set())  # as long as it is connected it must live
        self._connected = library("g_signal_connect_data", self._device, b"control-lost", self._on_lost, None, None, 0)

    @property
    def control_lost(self) -> bool:
        """Whether the driver has noticed that it does not control the camera any more; costs nothing."""
        return self._lost.is_set()

    def gone(self) -> bool:
        """Whether the camera does not answer, or does so as if it had just been switched on; asks it."""
        return self.control_lost or (self.is_gige and not read_register(self.address, CONTROL_PRIVILEGE))

    def close(self, stream: int | None = None, gone: bool = False) -> None:
        """Let go of a stream and then of the camera; in another thread if the camera is gone.

        The driver takes its leave of a camera, and waits for the answer of one that is gone for 2.5 s each time.
        """
        self._library("g_signal_handler_disconnect", self._device, self._connected)
        handles = [self.handle] if stream is None else [stream, self.handle]
        if gone:
            threading.Thread(target=self._unref, args=(handles,), name="release-camera", daemon=True).start()
        else:
            self._unref(handles)

    def _unref(self, handles: list[int]) -> None:
        for handle in handles:
            self._library.unref(handle)


def _locate(library: AravisLibrary, settings: CameraSettings, name: str, known: bool) -> tuple[str, str]:
    """What the library finds the camera by, and its address.

    A GigE camera with an address is asked for a sign of life first: the driver would wait for it for many seconds.
    """
    if settings.address is not None and read_register(settings.address, CONTROL_PRIVILEGE) is not None:
        return settings.address, settings.address
    if known and settings.address is not None:
        raise SourceError(name, "no answer", f"a camera at {settings.address}")
    found = _found(library)
    for device_id, serial, address in found:
        if serial == settings.serial:
            return device_id, address
    wanted = f"serial {settings.serial}" if settings.serial is not None else f"a camera at {settings.address}"
    told = ", ".join(f"{serial} at {address or 'USB'}" for _, serial, address in found)
    raise SourceError(name, told or "no camera at all", wanted)


def _found(library: AravisLibrary) -> list[tuple[str, ...]]:
    """Id, serial number and address of every camera that answers within a second."""
    library("arv_update_device_list")
    told = ("arv_get_device_id", "arv_get_device_serial_nbr", "arv_get_device_address")
    return [tuple(library.text(name, number) for name in told) for number in range(library("arv_get_n_devices"))]


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
        self.packet_bytes = 0
        self._trigger: dict[str, str] = {}

    def stop(self) -> None:
        """Stop the acquisition, whoever started it: cameras lock settings during one."""
        self._ask("acquisition", "stopped", "stop_acquisition")

    def set_image(self) -> None:
        """Set all that a frame depends on but its trigger, which is switched off."""
        settings = self.settings
        self._do("set_range_check_policy", RANGE_CHECK_ENABLE)
        for selector in self._selectors():
            self._set_string("TriggerSelector", selector)
            self._set_string("TriggerMode", "Off")
        self._set_string("AcquisitionMode", "Continuous")
        for feature in sfnc.SWITCHED_OFF:
            if self._has(feature):
                self._ask(feature, "off", "set_boolean", feature.encode(), 0)
        for feature in sfnc.AUTOMATIC:
            if self._has(feature):
                self._set_string(feature, "Off")
        rows, columns = self.frame_shape
        self._set_string("PixelFormat", settings.pixel_format)
        offsets = settings.offset_x_px, settings.offset_y_px
        self._ask("region", self._region(), "set_region", *offsets, columns, rows)
        for key, value in self._numbers():
            self._ask(key, value, f"set_{_NUMBERS[key]}", value)
        if self.connection.is_gige:
            self._set_packets()

    def _set_packets(self) -> None:
        """The size of packets: as asked for, as large as test packets get through, or as the network card takes."""
        with self._setting("packet_bytes", self.settings.packet_bytes or "one that gets through"):
            if self.settings.packet_bytes is not None:
                self.packet_bytes = self.settings.packet_bytes
            elif self._has("GevSCPSFireTestPacket"):
                self.packet_bytes = self._do("gv_auto_packet_size")
                return
            else:
                self.packet_bytes = route_mtu(self.connection.address)
            self._do("gv_set_packet_size", self.packet_bytes)

    def make_stream(self, payload: int) -> int:
        """A stream with empty buffers of `payload` bytes; it ends when it is let go of."""
        stream: int = self._ask("stream", "one", "create_stream", None, None, None)
        if self.connection.is_gige:
            self._library("g_object_set", stream, b"socket-buffer", c_int(SOCKET_BUFFER_AUTO), None)
        for _ in range(self.settings.buffers):
            self._library("arv_stream_push_buffer", stream, self._library("arv_buffer_new_allocate", payload))
        return stream

    def payload(self) -> int:
        """Bytes of a frame: its pixels, and whatever the camera adds to them."""
        rows, columns = self.frame_shape
        expected = pixel_format(self.settings.pixel_format).nbytes(rows * columns)
        payload: int = self._ask("PayloadSize", expected, "get_payload")
        if payload < expected:
            raise self._refused("PayloadSize", f"{expected} or more", payload, "")
        return payload

    def set_trigger(self) -> None:
        """Set the trigger; last of all, for some settings switch it off again."""
        knows_activation = self._has("TriggerActivation")
        self._trigger = sfnc.trigger_features(self.settings, self._selectors(), knows_activation)
        for feature, value in self._trigger.items():
            self._set_string(feature, value)

    def check(self) -> float:
        """Read everything back; returns the exposure time that the camera keeps, in seconds."""
        # The selector says only which trigger the others are of; a camera may go back to its own.
        wanted = {feature: value for feature, value in self._trigger.items() if feature != "TriggerSelector"}
        wanted |= {"AcquisitionMode": "Continuous", "PixelFormat": self.settings.pixel_format}
        for feature, expected in wanted.items():
            with self._setting(feature, expected):
                got = self._library.text("arv_camera_get_string", self._camera, feature.encode())
            self._compare(feature, got, expected)
        corners = [c_int() for _ in range(4)]
        self._ask("region", self._region(), "get_region", *map(byref, corners))
        x, y, columns, rows = (corner.value for corner in corners)
        self._compare("region", sfnc.describe_region(x, y, columns, rows), self._region())
        if self.connection.is_gige:
            kept_bytes = self._ask("packet_bytes", self.packet_bytes, "gv_get_packet_size")
            self._compare("packet_bytes", kept_bytes, self.packet_bytes)
        kept = {key: self._check_number(key, value) for key, value in self._numbers()}
        return 1e-6 * kept["exposure_us"]

    def frame_numbers(self) -> int:
        """See `sfnc.frame_numbers`."""
        extended = self._has("GevGVSPExtendedIDMode") and self._do("get_string", b"GevGVSPExtendedIDMode") == b"On"
        return sfnc.frame_numbers(self.connection.is_gige, extended)

    def start(self) -> None:
        """Start the acquisition; from here on a trigger makes a frame."""
        self._ask("acquisition", "started", "start_acquisition")

    def _do(self, what: str, *arguments: Any) -> Any:
        return self._library(f"arv_camera_{what}", self._camera, *arguments)

    def _ask(self, setting: str, expected: object, what: str, *arguments: Any) -> Any:
        """Do something about a setting, which a refusal names."""
        with self._setting(setting, expected):
            return self._do(what, *arguments)

    def _has(self, feature: str) -> bool:
        return bool(self._do("is_feature_available", feature.encode()))

    def _selectors(self) -> list[str]:
        """Triggers that it has, those that start a frame last."""
        if not self._has("TriggerSelector"):
            return []
        known = (*sfnc.OTHER_SELECTORS, *sfnc.FRAME_SELECTORS)
        entry = "is_enumeration_entry_available"
        return [name for name in known if self._do(entry, b"TriggerSelector", name.encode())]

    def _numbers(self) -> list[tuple[str, float]]:
        """Keys that are a number and are set, with it."""
        return [(key, value) for key in _NUMBERS if (value := getattr(self.settings, key)) is not None]

    def _set_string(self, feature: str, value: str) -> None:
        self._ask(feature, value, "set_string", feature.encode(), value.encode())

    def _check_number(self, key: str, expected: float) -> float:
        got = float(self._ask(key, expected, f"get_{_NUMBERS[key]}"))
        if abs(got - expected) > sfnc.tolerance(key, expected):
            raise self._refused(key, expected, got, "")
        return got

    def _compare(self, setting: str, got: object, expected: object) -> None:
        if got != expected:
            raise self._refused(setting, expected, got, "")

    def _region(self) -> str:
        rows, columns = self.frame_shape
        return sfnc.describe_region(self.settings.offset_x_px, self.settings.offset_y_px, columns, rows)

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
        subject, got, expected = sfnc.refusal(setting, asked, kept, told, lambda: self._offers(setting))
        return SourceError(f"{self.name}: {subject}", got, expected)

    def _offers(self, setting: str) -> str:
        """Entries or limits of a setting, empty where the camera tells none."""
        try:
            if setting == "region":
                sides = [c_int(), c_int()]
                self._do("get_sensor_size", *map(byref, sides))
                return f"a region of its sensor, {sides[0].value} x {sides[1].value} pixels, in its steps"
            if setting in _NUMBERS:
                limits = [c_double(), c_double()]
                self._do(f"get_{_NUMBERS[setting]}_bounds", *map(byref, limits))
                return f"{sfnc.between(*(limit.value for limit in limits))}, in its steps"
            count = c_uint32()
            entries = self._do("dup_available_enumerations_as_strings", setting.encode(), byref(count))
            return sfnc.one_of(entries[number].decode("utf-8", "replace") for number in range(count.value))
        except AravisError:
            return ""
