"""One camera that was found and opened with Aravis, until it is let go of or has gone away."""

from __future__ import annotations

import threading
from typing import Any

from lightpage.errors import SourceError
from lightpage.runtime.device.cameras.aravis_library import SIGNAL, AravisError, AravisLibrary, aravis
from lightpage.runtime.device.cameras.gige_network import CONTROL_PRIVILEGE, read_register
from lightpage.runtime.device.cameras.settings import CameraSettings

_DEVICE_ERRORS = "arv-device-error-quark"
_GONE = {2, 4, 5}
"""Not connected, transfer error, timeout: no answer. Whoever refuses is there."""


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
            self.serial = settings.serial or (
                library("arv_camera_get_device_serial_number", self.handle) or device_id.encode()
            ).decode("utf-8", "replace")
        except BaseException:
            library.unref(self.handle)
            raise
        self._lost = threading.Event()
        self._on_lost = SIGNAL(lambda *_: self._lost.set())  # as long as it is connected it must live
        self._connected = library.connect(self._device, "control-lost", self._on_lost)

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
        self._library.disconnect(self._device, self._connected)
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
        if settings.serial is not None and serial == settings.serial:
            return device_id, address
    wanted = f"serial {settings.serial}" if settings.serial is not None else f"a camera at {settings.address}"
    told = ", ".join(f"{serial} at {address or 'USB'}" for _, serial, address in found)
    raise SourceError(name, told or "no camera at all", wanted)


def _found(library: AravisLibrary) -> list[tuple[str, str, str]]:
    """Id, serial number and address of every camera that answers within a second."""
    library("arv_update_device_list")

    def text(name: str, number: int) -> str:
        value: Any = library(name, number)
        return (value or b"").decode("utf-8", "replace")

    return [
        (
            text("arv_get_device_id", number),
            text("arv_get_device_serial_nbr", number),
            text("arv_get_device_address", number),
        )
        for number in range(library("arv_get_n_devices"))
    ]
