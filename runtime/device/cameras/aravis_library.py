"""The one door to libaravis: the entry points that are used, with their types, and its errors as exceptions.

Calls release the interpreter's lock. An object of the library is used by one thread at a time. The library is loaded
when it is first asked for, so that a machine without cameras needs none. Its name is pinned to 0.8: in 0.10 some
functions take other arguments.
"""

from __future__ import annotations

import ctypes
import functools
import os
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_double, c_int, c_size_t, c_uint32, c_uint64, c_ulong, c_void_p
from typing import Any

from lightpage.errors import SourceError

ENVIRONMENT = "LIGHTPAGE_ARAVIS"
"""Names another file to load."""
LIBRARY = "libaravis-0.8.so.0"
PACKAGE = "libaravis-0.8-0"

SUCCESS, SIZE_MISMATCH = 0, 5
BUFFER_STATUS = {
    -1: "unknown",
    1: "cleared",
    2: "not complete in time",
    3: "packets lost",
    4: "a wrong packet number",
    5: "larger than its buffer",
    6: "still being filled",
    7: "aborted",
    8: "payload that is not supported",
}
"""ArvBufferStatus, but for success."""
SOCKET_BUFFER_AUTO = 1
RANGE_CHECK_ENABLE = 1

FILL = ctypes.CFUNCTYPE(None, c_void_p, c_void_p, c_uint32, c_uint32, c_uint32)
"""ArvFakeCameraFillPattern: buffer, data, exposure in microseconds, gain, pixel format."""
SIGNAL = ctypes.CFUNCTYPE(None, c_void_p, c_void_p)
"""A handler of a signal without arguments: object, data."""

_G_TYPE_INT, _G_TYPE_DOUBLE = 6 << 2, 15 << 2


class _GError(ctypes.Structure):
    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


class _GValue(ctypes.Structure):
    _fields_ = (("type", c_size_t), ("data", c_uint64 * 2))


_ERROR = POINTER(POINTER(_GError))

_FALLIBLE: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_camera_new": (c_void_p, (c_char_p,)),
    "arv_camera_get_device_serial_number": (c_char_p, (c_void_p,)),
    "arv_camera_is_feature_available": (c_int, (c_void_p, c_char_p)),
    "arv_camera_is_enumeration_entry_available": (c_int, (c_void_p, c_char_p, c_char_p)),
    "arv_camera_dup_available_enumerations_as_strings": (POINTER(c_char_p), (c_void_p, c_char_p, POINTER(c_uint32))),
    "arv_camera_get_exposure_time_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_get_gain_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_get_black_level_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_get_sensor_size": (None, (c_void_p, POINTER(c_int), POINTER(c_int))),
    "arv_camera_set_string": (None, (c_void_p, c_char_p, c_char_p)),
    "arv_camera_get_string": (c_char_p, (c_void_p, c_char_p)),
    "arv_camera_set_boolean": (None, (c_void_p, c_char_p, c_int)),
    "arv_camera_set_region": (None, (c_void_p, c_int, c_int, c_int, c_int)),
    "arv_camera_get_region": (None, (c_void_p, POINTER(c_int), POINTER(c_int), POINTER(c_int), POINTER(c_int))),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p,)),
    "arv_camera_set_gain": (None, (c_void_p, c_double)),
    "arv_camera_get_gain": (c_double, (c_void_p,)),
    "arv_camera_set_black_level": (None, (c_void_p, c_double)),
    "arv_camera_get_black_level": (c_double, (c_void_p,)),
    "arv_camera_get_payload": (c_uint32, (c_void_p,)),
    "arv_camera_gv_set_packet_size": (None, (c_void_p, c_int)),
    "arv_camera_gv_get_packet_size": (c_uint32, (c_void_p,)),
    "arv_camera_gv_auto_packet_size": (c_uint32, (c_void_p,)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p)),
    "arv_camera_start_acquisition": (None, (c_void_p,)),
    "arv_camera_stop_acquisition": (None, (c_void_p,)),
    "arv_camera_software_trigger": (None, (c_void_p,)),
}
"""Result and arguments of what reports an error as its last argument."""
_PLAIN: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint32, ()),
    "arv_get_device_id": (c_char_p, (c_uint32,)),
    "arv_get_device_serial_nbr": (c_char_p, (c_uint32,)),
    "arv_get_device_address": (c_char_p, (c_uint32,)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_camera_set_range_check_policy": (None, (c_void_p, c_int)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_try_pop_buffer": (c_void_p, (c_void_p,)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_stream_get_statistics": (None, (c_void_p, POINTER(c_uint64), POINTER(c_uint64), POINTER(c_uint64))),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_system_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "arv_buffer_get_image_pixel_format": (c_uint32, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_fake_camera_new": (c_void_p, (c_char_p,)),
    "arv_fake_camera_get_genicam_xml": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_fake_camera_set_fill_pattern": (None, (c_void_p, FILL, c_void_p)),
    "arv_fake_camera_set_trigger_frequency": (None, (c_void_p, c_double)),
    "arv_fake_camera_get_acquisition_status": (c_uint32, (c_void_p,)),
    "arv_fake_camera_read_register": (c_int, (c_void_p, c_uint32, POINTER(c_uint32))),
    "arv_fake_camera_write_register": (c_int, (c_void_p, c_uint32, c_uint32)),
    "arv_gv_fake_camera_new_full": (c_void_p, (c_char_p, c_char_p, c_char_p)),
    "arv_gv_fake_camera_is_running": (c_int, (c_void_p,)),
    "arv_gv_fake_camera_get_fake_camera": (c_void_p, (c_void_p,)),
}
_OPTIONAL: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_buffer_get_image_padding": (None, (c_void_p, POINTER(c_int), POINTER(c_int))),
}
"""What earlier versions lack."""


class AravisError(Exception):
    """What the library reports, before it becomes an error of this program.

    Attributes:
        domain: which part of the library.
        code: of the error in its domain.
        message: for people.
    """

    def __init__(self, domain: str, code: int, message: str) -> None:
        super().__init__(f"{message} ({domain} {code})")
        self.domain, self.code, self.message = domain, code, message


class AravisLibrary:
    """The library, loaded. Functions are called by their names in C; those that report an error raise it.

    Args:
        path: of libaravis.

    Raises:
        SourceError: it is missing, or is another version.
    """

    def __init__(self, path: str) -> None:
        try:
            library = ctypes.CDLL(path)
            self._functions: dict[str, Callable[..., Any]] = {
                name: _typed(library, name, result, arguments) for name, (result, arguments) in _PLAIN.items()
            }
            self._functions |= {
                name: _typed(library, name, result, arguments)
                for name, (result, arguments) in _OPTIONAL.items()
                if hasattr(library, name)
            }
            for name, (result, arguments) in _FALLIBLE.items():
                function = _typed(library, name, result, (*arguments, _ERROR))
                self._functions[name] = functools.partial(self._checked, function)
            version = tuple(_typed(library, f"arv_get_{part}_version", c_uint32, ())() for part in ("major", "minor"))
            # GLib's functions too: the loader looks for them in what libaravis itself is linked to.
            self._unref = _typed(library, "g_object_unref", None, (c_void_p,))
            self._connect = _typed(
                library, "g_signal_connect_data", c_ulong, (c_void_p, c_char_p, SIGNAL, c_void_p, c_void_p, c_int)
            )
            self._disconnect = _typed(library, "g_signal_handler_disconnect", None, (c_void_p, c_ulong))
            self._init_value = _typed(library, "g_value_init", c_void_p, (POINTER(_GValue), c_size_t))
            self._set_int = _typed(library, "g_value_set_int", None, (POINTER(_GValue), c_int))
            self._set_double = _typed(library, "g_value_set_double", None, (POINTER(_GValue), c_double))
            self._set_property = _typed(library, "g_object_set_property", None, (c_void_p, c_char_p, POINTER(_GValue)))
            self._quark = _typed(library, "g_quark_to_string", c_char_p, (c_uint32,))
            self._free_error = _typed(library, "g_error_free", None, (POINTER(_GError),))
        except (OSError, AttributeError) as error:
            raise SourceError("camera driver aravis", error, _wanted()) from None
        if version != (0, 8):
            raise SourceError(f"camera driver aravis: {path}", f"version {version[0]}.{version[1]}", _wanted())

    def __call__(self, name: str, *arguments: Any) -> Any:
        """Call a function by its name.

        Raises:
            AravisError: what it reports.
        """
        return self._functions[name](*arguments)

    def knows(self, name: str) -> bool:
        """Whether this version of it has a function."""
        return name in self._functions

    def set_property(self, instance: int, name: str, value: int | float) -> None:
        """Set a property: a float where it is a double, an int where it is an integer or an enumeration."""
        held = _GValue()
        if isinstance(value, float):
            self._init_value(held, _G_TYPE_DOUBLE)
            self._set_double(held, value)
        else:
            self._init_value(held, _G_TYPE_INT)
            self._set_int(held, value)
        self._set_property(instance, name.encode(), held)

    def connect(self, instance: int, signal: str, handler: Callable[..., None]) -> int:
        """Have `handler`, a `SIGNAL` that is kept alive, called from the library's thread; returns its number."""
        return int(self._connect(instance, signal.encode(), handler, None, None, 0))

    def disconnect(self, instance: int, number: int) -> None:
        """Call a handler no more."""
        self._disconnect(instance, number)

    def unref(self, instance: int) -> None:
        """Let go of an object."""
        self._unref(instance)

    def _checked(self, function: Callable[..., Any], *arguments: Any) -> Any:
        error = POINTER(_GError)()
        result = function(*arguments, ctypes.byref(error))
        if error:
            told = error.contents
            raised = AravisError(
                (self._quark(told.domain) or b"").decode(), told.code, told.message.decode("utf-8", "replace")
            )
            self._free_error(error)
            raise raised
        return result


def _typed(library: ctypes.CDLL, name: str, result: Any, arguments: tuple[Any, ...]) -> Callable[..., Any]:
    function: Any = getattr(library, name)
    function.restype, function.argtypes = result, arguments
    typed: Callable[..., Any] = function
    return typed


def _wanted() -> str:
    return f"{LIBRARY}, of the Debian package {PACKAGE}, or its path in {ENVIRONMENT}"


def aravis() -> AravisLibrary:
    """The library, loaded once.

    Raises:
        SourceError: see `AravisLibrary`.
    """
    return _load(os.environ.get(ENVIRONMENT) or LIBRARY)


@functools.cache
def _load(path: str) -> AravisLibrary:
    return AravisLibrary(path)
