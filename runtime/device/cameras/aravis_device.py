"""A camera under Aravis: found, opened and given its settings, until it is released or has gone away."""

import threading
from ctypes import byref, c_double, c_int, c_uint32
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
from lightpage.runtime.device.cameras.settings import CameraSettings

_DEVICE_ERRORS = "arv-device-error-quark"
_GONE = {2, 4, 5}
"""Not connected, transfer error, timeout: no answer. Whoever refuses is there."""
_NUMBERS = {
    "exposure_us": "{}_exposure_time",
    "gain_db": "{}_gain",
    "black_level_counts": "{}_black_level",
    "packet_bytes": "gv_{}_packet_size",
    "PayloadSize": "{}_payload",
}
"""How the library gets and sets numbers, by their keys and features."""


def says_gone(error: AravisError) -> bool:
    """Return whether the library means that the camera does not answer."""
    return error.domain == _DEVICE_ERRORS and error.code in _GONE


class AravisConnection:
    """A camera under this program's control. One thread at a time uses it.

    Args:
        settings: which camera.
        name: name of the camera, for errors.
        known: whether it was open before. If one with an address is gone, then nobody looks for what else is there.

    Attributes:
        handle: handle of the ArvCamera.
        is_gige: whether it is a GigE camera.
        serial: its number.
        address: address of a GigE camera, else empty.

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
        """Return whether the driver has noticed that it does not control the camera any more; costs nothing."""
        return self._lost.is_set()

    def gone(self) -> bool:
        """Return whether the camera does not answer, or does so as if it had just been switched on; asks it."""
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
    """Return what the library finds the camera by, and its address.

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


class AravisSetup(sfnc.CameraSetup):
    """See `CameraSetup`; what says that the camera is gone is an `AravisError`.

    Args:
        connection: the camera.
        settings, frame_shape, name: see `CameraSetup`.
    """

    refusals = (AravisError,)

    def __init__(
        self, connection: AravisConnection, settings: CameraSettings, frame_shape: tuple[int, int], name: str
    ) -> None:
        super().__init__(settings, frame_shape, name, connection.is_gige)
        self._library, self._camera, self._address = aravis(), connection.handle, connection.address
        self.packet_bytes = 0

    def stop(self) -> None:
        """Stop the acquisition, whoever started it: cameras lock settings during one."""
        with self.setting("acquisition", "stopped"):
            self._do("stop_acquisition")

    def start(self) -> None:
        """Start the acquisition; from here on a trigger makes a frame."""
        with self.setting("acquisition", "started"):
            self._do("start_acquisition")

    def set_image(self) -> None:
        """See `CameraSetup`."""
        self._do("set_range_check_policy", RANGE_CHECK_ENABLE)
        super().set_image()
        if self.is_gige:
            self._set_packets()

    def _set_packets(self) -> None:
        """The size of packets: as asked for, as large as test packets get through, or as the network card takes."""
        asked = self.settings.packet_bytes
        if asked is None and self.has("GevSCPSFireTestPacket"):
            with self.setting("packet_bytes", "one that gets through"):
                self.packet_bytes = self._set["packet_bytes"] = self._do("gv_auto_packet_size")
        else:
            self.packet_bytes = asked or route_mtu(self._address)
            self.set("packet_bytes", self.packet_bytes)

    def make_stream(self, payload: int) -> int:
        """A stream with empty buffers of `payload` bytes; it ends when it is let go of."""
        with self.setting("stream", "one"):
            stream: int = self._do("create_stream", None, None, None)
        if self.is_gige:
            self._library("g_object_set", stream, b"socket-buffer", c_int(SOCKET_BUFFER_AUTO), None)
        for _ in range(self.settings.buffers):
            self._library("arv_stream_push_buffer", stream, self._library("arv_buffer_new_allocate", payload))
        return stream

    def has(self, feature: str) -> bool:
        """See `CameraSetup`."""
        return feature in _NUMBERS or bool(self._do("is_feature_available", feature.encode()))

    def entries(self, feature: str) -> list[str]:
        """See `CameraSetup`."""
        count = c_uint32()
        found = self._do("dup_available_enumerations_as_strings", feature.encode(), byref(count))
        try:
            return [found[number].decode("utf-8", "replace") for number in range(count.value)]
        finally:
            self._library("g_free", found)

    def write(self, feature: str, value: Any) -> None:
        """See `CameraSetup`."""
        if feature in _NUMBERS:
            self._do(_NUMBERS[feature].format("set"), value)
        elif feature == "region":
            self._do("set_region", *value)
        elif isinstance(value, bool):
            self._do("set_boolean", feature.encode(), value)
        else:
            self._do("set_string", feature.encode(), value.encode())

    def read(self, feature: str, kind: type) -> Any:
        """See `CameraSetup`."""
        if feature in _NUMBERS:
            return self._do(_NUMBERS[feature].format("get"))
        if feature == "region":
            return sfnc.Region(*self._numbers("get_region", c_int, 4))
        if kind is bool:
            return bool(self._do("get_boolean", feature.encode()))
        return self._library.text("arv_camera_get_string", self._camera, feature.encode())

    def limits(self, feature: str) -> str:
        """See `CameraSetup`."""
        if feature == "region":
            columns, rows = self._numbers("get_sensor_size", c_int, 2)
            return f"a region of its sensor, {columns} x {rows} pixels, in its steps"
        return sfnc.between(*self._numbers(f"{_NUMBERS[feature]}_bounds".format("get"), c_double, 2))

    def told(self, error: Exception) -> str:
        """See `CameraSetup`."""
        assert isinstance(error, AravisError)  # as `refusals` says
        if says_gone(error):
            raise error
        return error.message

    def _do(self, what: str, *arguments: Any) -> Any:
        return self._library(f"arv_camera_{what}", self._camera, *arguments)

    def _numbers(self, what: str, kind: type[c_int] | type[c_double], count: int) -> list[Any]:
        """Numbers that the library puts in places that it is given."""
        places = [kind() for _ in range(count)]
        self._do(what, *map(byref, places))
        return [place.value for place in places]
