"""The one door to libaravis: the entry points that are used, with their types, and its errors as exceptions.

Calls release the interpreter's lock. An object of the library is used by one thread at a time. The library is loaded
when it is first asked for, so that a machine without cameras needs none. Its name is pinned to 0.8: in 0.10 some
functions take other arguments.
"""

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
_WANTED = f"{LIBRARY}, of the Debian package {PACKAGE}, or its path in {ENVIRONMENT}"

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

SIGNAL = ctypes.CFUNCTYPE(None, c_void_p, c_void_p)
"""A handler of a signal without arguments: object, data."""

Signatures = dict[str, tuple[Any, tuple[Any, ...]]]
"""Result and arguments of functions, by name."""


class _GError(ctypes.Structure):
    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


_ERROR = POINTER(POINTER(_GError))

_NUMBERS = ("exposure_time", "gain", "black_level")
_FALLIBLE: Signatures = {
    "arv_camera_new": (c_void_p, (c_char_p,)),
    "arv_camera_get_device_serial_number": (c_char_p, (c_void_p,)),
    "arv_camera_is_feature_available": (c_int, (c_void_p, c_char_p)),
    "arv_camera_dup_available_enumerations_as_strings": (POINTER(c_char_p), (c_void_p, c_char_p, POINTER(c_uint32))),
    "arv_camera_get_sensor_size": (None, (c_void_p, POINTER(c_int), POINTER(c_int))),
    "arv_camera_set_string": (None, (c_void_p, c_char_p, c_char_p)),
    "arv_camera_get_string": (c_char_p, (c_void_p, c_char_p)),
    "arv_camera_set_boolean": (None, (c_void_p, c_char_p, c_int)),
    "arv_camera_get_boolean": (c_int, (c_void_p, c_char_p)),
    "arv_camera_set_region": (None, (c_void_p, c_int, c_int, c_int, c_int)),
    "arv_camera_get_region": (None, (c_void_p, POINTER(c_int), POINTER(c_int), POINTER(c_int), POINTER(c_int))),
    **{f"arv_camera_set_{name}": (None, (c_void_p, c_double)) for name in _NUMBERS},
    **{f"arv_camera_get_{name}": (c_double, (c_void_p,)) for name in _NUMBERS},
    **{f"arv_camera_get_{name}_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))) for name in _NUMBERS},
    "arv_camera_get_payload": (c_uint32, (c_void_p,)),
    "arv_camera_gv_set_packet_size": (None, (c_void_p, c_int)),
    "arv_camera_gv_get_packet_size": (c_uint32, (c_void_p,)),
    "arv_camera_gv_auto_packet_size": (c_uint32, (c_void_p,)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p)),
    **{f"arv_camera_{name}_acquisition": (None, (c_void_p,)) for name in ("start", "stop")},
    "arv_camera_software_trigger": (None, (c_void_p,)),
}
"""Result and arguments of what reports an error as its last argument."""
_PLAIN: Signatures = {
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint32, ()),
    **{f"arv_get_device_{name}": (c_char_p, (c_uint32,)) for name in ("id", "serial_nbr", "address")},
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_camera_set_range_check_policy": (None, (c_void_p, c_int)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_try_pop_buffer": (c_void_p, (c_void_p,)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_stream_get_statistics": (None, (c_void_p, POINTER(c_uint64), POINTER(c_uint64), POINTER(c_uint64))),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    **{f"arv_buffer_get_{name}": (c_int, (c_void_p,)) for name in ("status", "image_width", "image_height")},
    **{f"arv_buffer_get_{name}": (c_uint64, (c_void_p,)) for name in ("frame_id", "timestamp", "system_timestamp")},
    "arv_buffer_get_image_pixel_format": (c_uint32, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    # GLib's functions too: the loader looks for them in what libaravis itself is linked to.
    "g_free": (None, (c_void_p,)),
    "g_object_unref": (None, (c_void_p,)),
    "g_object_set": (None, (c_void_p, c_char_p)),  # and a value of the property's own type, and None
    "g_signal_connect_data": (c_ulong, (c_void_p, c_char_p, SIGNAL, c_void_p, c_void_p, c_int)),
    "g_signal_handler_disconnect": (None, (c_void_p, c_ulong)),
    "g_quark_to_string": (c_char_p, (c_uint32,)),
    "g_error_free": (None, (POINTER(_GError),)),
}
_OPTIONAL: Signatures = {"arv_buffer_get_image_padding": (None, (c_void_p, POINTER(c_int), POINTER(c_int)))}
"""What earlier versions lack."""


class AravisError(Exception):
    """An error of the library, before it becomes an error of this program.

    Attributes:
        domain: which part of the library.
        code: code of the error in its domain.
        message: message for people.
    """

    def __init__(self, domain: str, code: int, message: str) -> None:
        super().__init__(f"{message} ({domain} {code})")
        self.domain, self.code, self.message = domain, code, message


class AravisLibrary:
    """The library, loaded. Functions are called by their names in C; those that report an error raise it.

    Args:
        path: path of libaravis.

    Raises:
        SourceError: it is missing, or is another version.
    """

    def __init__(self, path: str) -> None:
        try:
            self._library = library = ctypes.CDLL(path)
            self._functions: dict[str, Callable[..., Any]] = {}
            self.declare(_PLAIN)
            self.declare({name: types for name, types in _OPTIONAL.items() if hasattr(library, name)})
            for name, (result, arguments) in _FALLIBLE.items():
                function = _typed(library, name, result, (*arguments, _ERROR))
                self._functions[name] = functools.partial(self._checked, function)
            version = tuple(_typed(library, f"arv_get_{part}_version", c_uint32, ())() for part in ("major", "minor"))
        except (OSError, AttributeError) as error:
            raise SourceError("camera driver aravis", error, _WANTED) from None
        if version != (0, 8):
            raise SourceError(f"camera driver aravis: {path}", f"version {version[0]}.{version[1]}", _WANTED)

    def declare(self, functions: Signatures) -> None:
        """Make functions callable that report no error."""
        for name, (result, arguments) in functions.items():
            self._functions[name] = _typed(self._library, name, result, arguments)

    def __call__(self, name: str, *arguments: Any) -> Any:
        """Call a function by its name.

        Raises:
            AravisError: what it reports.
        """
        return self._functions[name](*arguments)

    def knows(self, name: str) -> bool:
        """Return whether this version of it has a function."""
        return name in self._functions

    def text(self, name: str, *arguments: Any) -> str:
        """Text that a function returns, empty where it returns none; see `__call__`."""
        return (self(name, *arguments) or b"").decode("utf-8", "replace")

    def unref(self, instance: int) -> None:
        """Let go of an object."""
        self("g_object_unref", instance)

    def _checked(self, function: Callable[..., Any], *arguments: Any) -> Any:
        error = POINTER(_GError)()
        result = function(*arguments, ctypes.byref(error))
        if error:
            told = error.contents
            domain = self.text("g_quark_to_string", told.domain)
            raised = AravisError(domain, told.code, told.message.decode("utf-8", "replace"))
            self("g_error_free", error)
            raise raised
        return result


def _typed(library: ctypes.CDLL, name: str, result: Any, arguments: tuple[Any, ...]) -> Callable[..., Any]:
    function = library[name]
    function.restype, function.argtypes = result, arguments
    return function


def aravis() -> AravisLibrary:
    """The library, loaded once.

    Raises:
        SourceError: see `AravisLibrary`.
    """
    return _load(os.environ.get(ENVIRONMENT) or LIBRARY)


@functools.cache
def _load(path: str) -> AravisLibrary:
    return AravisLibrary(path)
