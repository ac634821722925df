"""A GigE Vision camera on loopback: the library's own fake, its frames from a function, sent as real packets.

Two of them need two addresses: see `lightpage.virtual_device.namespace`.
"""

from __future__ import annotations

import ctypes
import socket
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_double, c_int, c_size_t, c_uint32, c_void_p
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError, LightpageError, SourceError
from lightpage.runtime.device.cameras.aravis_library import AravisLibrary, Signatures, aravis
from lightpage.runtime.device.cameras.gige_network import PORT
from lightpage.runtime.device.cameras.pixel_formats import FORMATS, pixel_format
from lightpage.temporary import temporary_folder
from lightpage.virtual_device.packing import pack

Picture = Callable[[], NDArray[np.unsignedinteger[Any]]]

_FILL = ctypes.CFUNCTYPE(None, c_void_p, c_void_p, c_uint32, c_uint32, c_uint32)
"""ArvFakeCameraFillPattern: buffer, data, exposure in microseconds, gain, pixel format."""
_FUNCTIONS: Signatures = {
    "arv_fake_camera_new": (c_void_p, (c_char_p,)),
    "arv_fake_camera_get_genicam_xml": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_fake_camera_set_fill_pattern": (None, (c_void_p, _FILL, c_void_p)),
    "arv_fake_camera_set_trigger_frequency": (None, (c_void_p, c_double)),
    "arv_fake_camera_get_acquisition_status": (c_uint32, (c_void_p,)),
    "arv_fake_camera_read_register": (c_int, (c_void_p, c_uint32, POINTER(c_uint32))),
    "arv_fake_camera_write_register": (c_int, (c_void_p, c_uint32, c_uint32)),
    "arv_gv_fake_camera_new_full": (c_void_p, (c_char_p, c_char_p, c_char_p)),
    "arv_gv_fake_camera_is_running": (c_int, (c_void_p,)),
    "arv_gv_fake_camera_get_fake_camera": (c_void_p, (c_void_p,)),
}
_ADDED_FORMATS = ("Mono10", "Mono10p", "Mono10Packed", "Mono12", "Mono12p", "Mono12Packed")
"""Beside Mono8 and Mono16, which the library's fake knows by itself."""
_ROWS, _COLUMNS, _X, _Y = 0x104, 0x100, 0x130, 0x134
_SENSOR_ROWS, _SENSOR_COLUMNS = 0x118, 0x11C
_PIXEL_FORMAT, _PERIOD_US = 0x128, 0x138
_TRIGGER_MODE, _LIBRARY_TRIGGER_SOURCE, _SHOOT = 0x300, 0x304, 0x30C
_TRIGGER_SOURCE = 0x3F4
"""Address of the trigger's source in the edited description. The library shoots on a command only while its own
register says ``Software``, and it would read that back whatever was chosen."""
_SOFTWARE = 1
_LINES = {"Line0": 0, "Line1": 2}
_PAYLOAD = "WIDTH * HEIGHT * ((PIXELFORMAT>>16)&amp;0xFF) / 8"
"""Formula of its PayloadSize."""
_POLLS_HZ = 250.0
"""Rate at which a waiting camera looks for a trigger."""


class FakeCamera:
    """A camera that sends what `picture` returns when it exposes. Use it in a `with` statement, or `close` it.

    It takes `edge` and software triggers, the latter whatever its source is set to. Its first frame after the start of
    an acquisition may be up to 0.1 s late.

    Args:
        address: address to listen on, of an interface of this machine.
        serial: serial number of the camera.
        picture: the whole sensor [row, column], called by the camera's own thread; the region that is set is sent.
        sensor_shape: (rows, columns).
        more_bytes: bytes by which its PayloadSize is larger than the pixels that it sends.

    Raises:
        SourceError: no library, or the address cannot be listened on.
    """

    def __init__(
        self,
        address: str,
        serial: str,
        picture: Picture,
        sensor_shape: tuple[int, int] = (2048, 2048),
        more_bytes: int = 0,
    ) -> None:
        self.address, self.serial = address, serial
        self._picture, self._shape, self._more_bytes = picture, sensor_shape, more_bytes
        self._library = aravis()
        self._library.declare(_FUNCTIONS)
        self._fill = _FILL(self._filled)  # must outlive the camera
        self._camera: int | None = None
        self._error: Exception | None = None
        self.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def start(self) -> None:
        """Switch it on, unless it is on; as after a loss of power, it begins with its usual settings and numbers.

        Raises:
            SourceError: the address cannot be listened on.
        """
        if self._camera is not None:
            return
        _check_free(self.address)
        with temporary_folder(f"fake camera {self.serial}") as folder:
            description = Path(folder) / "camera.xml"
            description.write_text(_description(self._library, self._more_bytes), "utf-8")
            camera = self._library(
                "arv_gv_fake_camera_new_full", self.address.encode(), self.serial.encode(), str(description).encode()
            )
        if not self._library("arv_gv_fake_camera_is_running", camera):
            self._library.unref(camera)
            raise SourceError(f"fake camera {self.serial}", f"not listening on {self.address}", "an own address")
        self._inner: int = self._library("arv_gv_fake_camera_get_fake_camera", camera)
        self._library("arv_fake_camera_set_trigger_frequency", self._inner, _POLLS_HZ)
        self._library("arv_fake_camera_set_fill_pattern", self._inner, self._fill, None)
        rows, columns = self._shape
        for register, value in (
            (_LIBRARY_TRIGGER_SOURCE, _SOFTWARE),
            (_SENSOR_ROWS, rows),
            (_SENSOR_COLUMNS, columns),
            (_ROWS, rows),
            (_COLUMNS, columns),
        ):
            self._write(register, value)
        self._camera = camera

    def close(self) -> None:
        """Switch it off, as by pulling its plug; `start` switches it on again."""
        if self._camera is not None:
            camera, self._camera = self._camera, None
            self._library.unref(camera)

    def edge(self, line: str = "Line1") -> bool:
        """An edge on one of its lines; returns whether that triggers it: it waits, and for this line."""
        if self._camera is None or not self.waits or self._read(_TRIGGER_SOURCE) != _LINES[line]:
            return False
        self._write(_SHOOT, 1)
        return True

    @property
    def waits(self) -> bool:
        """Return whether a trigger makes a frame now: the camera acquires, and its trigger is on."""
        if self._camera is None:
            return False
        return bool(self._library("arv_fake_camera_get_acquisition_status", self._inner)) and bool(
            self._read(_TRIGGER_MODE)
        )

    def run_freely(self, period_s: float) -> None:
        """Switch the trigger off behind its user's back: an acquisition goes on with a frame every `period_s`."""
        if self._camera is not None:
            self._write(_PERIOD_US, round(1e6 * period_s))
            self._write(_TRIGGER_MODE, 0)

    def change_format(self, name: str) -> None:
        """Change its pixel format behind its user's back."""
        if self._camera is not None:
            self._write(_PIXEL_FORMAT, pixel_format(name).code)

    def lose(self, share: float) -> None:
        """Lose this share of the packets on the way from now on; lost ones are never sent again."""
        if self._camera is not None:
            self._library("g_object_set", self._camera, b"gvsp-lost-ratio", c_double(share), None)

    def check(self) -> None:
        """Raise what went wrong with a picture; its frame was sent all the same."""
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _filled(self, buffer: int, _data: int | None, _exposure: int, _gain: int, code: int) -> None:
        """Called by the library for each frame; what is raised here would only be printed."""
        try:
            rows, columns = self._read(_ROWS), self._read(_COLUMNS)
            x, y = self._read(_X), self._read(_Y)
            image = self._picture()
            if image.shape != self._shape:
                raise FrameError(f"picture of fake camera {self.serial}", image.shape, self._shape)
            name = next(known.name for known in FORMATS.values() if known.code == code)
            sent = pack(image[y : y + rows, x : x + columns], name)
            ctypes.memmove(self._library("arv_buffer_get_data", buffer, None), sent.ctypes.data, sent.nbytes)
        except Exception as error:
            self._error = self._error or error

    def _read(self, register: int) -> int:
        value = c_uint32()
        self._library("arv_fake_camera_read_register", self._inner, register, ctypes.byref(value))
        return value.value

    def _write(self, register: int, value: int) -> None:
        self._library("arv_fake_camera_write_register", self._inner, register, value)


def _check_free(address: str) -> None:
    """Check that no other camera has the address: a second one would claim to run, and hear nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, PORT))
        except OSError as error:
            raise SourceError(f"fake camera on {address}", error, "an own address on this machine, free") from None


def _description(library: AravisLibrary, more_bytes: int = 0) -> str:
    """The GenICam description of the library's fake, and in it more pixel formats, a second line and its register."""
    plain = library("arv_fake_camera_new", b"description")
    try:
        size = c_size_t()
        text = ctypes.string_at(library("arv_fake_camera_get_genicam_xml", plain, ctypes.byref(size)), size.value)
    finally:
        library.unref(plain)
    entries = "".join(_entry(name, pixel_format(name).code) for name in _ADDED_FORMATS)
    edited = text.rstrip(b"\0").decode("utf-8")
    edited = _before(edited, '<EnumEntry Name="Mono16"', entries)
    edited = _replaced(edited, _PAYLOAD, f"{_PAYLOAD} + {more_bytes}")
    edited = _before(edited, '<EnumEntry Name="Software"', _entry("Line1", _LINES["Line1"]))
    return _replaced(
        edited, f"<Address>{_LIBRARY_TRIGGER_SOURCE:#x}</Address>", f"<Address>{_TRIGGER_SOURCE:#x}</Address>"
    )


def _entry(name: str, value: int) -> str:
    return f'<EnumEntry Name="{name}" NameSpace="Standard"><Value>{value}</Value></EnumEntry>\n'


def _before(text: str, mark: str, added: str) -> str:
    return _replaced(text, mark, added + mark)


def _replaced(text: str, old: str, new: str) -> str:
    if text.count(old) != 1:
        raise LightpageError("description of the library's fake camera", f"{old} {text.count(old)} times", "once")
    return text.replace(old, new)
