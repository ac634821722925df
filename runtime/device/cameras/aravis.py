"""GigE Vision and USB3 Vision cameras, driven by Aravis."""

import ctypes
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import FrameError, LostShotError, Reason, SourceError
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.device.cameras import sfnc
from lightpage.runtime.device.cameras.aravis_device import AravisConnection, AravisSetup, says_gone
from lightpage.runtime.device.cameras.aravis_library import (
    BUFFER_STATUS,
    SIZE_MISMATCH,
    SUCCESS,
    AravisError,
    AravisLibrary,
    aravis,
)
from lightpage.runtime.device.cameras.camera import BrokenFrame, DrivenCamera, Frame
from lightpage.runtime.device.cameras.gige_network import receive_buffer_problem
from lightpage.runtime.device.cameras.pixel_formats import pixel_format, unpack, without_padding
from lightpage.runtime.device.cameras.settings import CameraSettings

_log = logging.getLogger(__name__)

_RECENTLY_S = 0.5
"""A camera that answered so lately is not asked again before a command: the driver waits for seconds for one that is
gone, and asking takes time from the command."""


class AravisCamera(DrivenCamera):
    """A camera of `lightpage.runtime.device.cameras.camera.Camera`; see `DrivenCamera` for its arguments."""

    def __init__(self, settings: CameraSettings, frame_shape: tuple[int, int], role: str = "camera") -> None:
        super().__init__(settings, frame_shape, role)
        self._connection: AravisConnection | None = None
        self._stream: int | None = None
        self._exposure_s: float | None = None
        self._packet_bytes = 0
        self._hint = ""
        self._earlier = 0
        self._answered_at = -float("inf")

    @property
    def whole_frames(self) -> int:
        """Frames that have arrived whole since the camera was made."""
        if self._stream is None:
            return self._earlier
        completed = ctypes.c_uint64()
        aravis()("arv_stream_get_statistics", self._stream, ctypes.byref(completed), None, None)
        return self._earlier + completed.value

    def arm(self) -> None:
        """See `Camera`."""
        if self._connection is not None and self._connection.gone():
            self._release(gone=True)
        if self._connection is None:
            self._open()
        with self._answering():
            self._set_up()

    def fire(self) -> None:
        """See `Camera`."""
        connection = self._armed()[0]
        if time.monotonic() - self._answered_at > _RECENTLY_S and connection.gone():
            raise self._lose("no answer")
        with self._answering():
            aravis()("arv_camera_software_trigger", connection.handle)
        self._answered_at = time.monotonic()

    def frame(self, timeout_s: float) -> Frame | BrokenFrame | None:
        """See `Camera`."""
        connection, stream = self._armed()
        library = aravis()
        if timeout_s > 0:
            buffer = library("arv_stream_timeout_pop_buffer", stream, int(1e6 * timeout_s))
        else:
            buffer = library("arv_stream_try_pop_buffer", stream)
        if buffer is None:
            if connection.control_lost or (timeout_s >= sfnc.SIGN_OF_LIFE_S and connection.gone()):
                raise self._lose("no answer")
            return None
        self._answered_at = time.monotonic()
        try:
            return self._read(library, buffer, connection.serial)
        finally:
            library("arv_stream_push_buffer", stream, buffer)

    def disarm(self) -> None:
        """See `Camera`."""
        if self._connection is None or self._stream is None:
            return
        if self._connection.gone():
            self._release(gone=True)
            return
        try:
            aravis()("arv_camera_stop_acquisition", self._connection.handle)
        except AravisError as error:
            _log.warning("%s: not stopped: %s", self.name, error)
            self._release(gone=says_gone(error))
        self._drop_stream()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        self._release(gone=self._connection is not None and self._connection.gone())

    def _open(self) -> None:
        try:
            self._connection = AravisConnection(self._settings, self.name, known=self.opened > 0)
        except AravisError as error:
            raise self._absent(self.opened > 0, error.message, "a camera that can be opened") from None
        except SourceError as error:
            if self.opened:
                raise self._absent(True, error.got, error.expected) from None
            raise
        self.name = f"{self._role} ({self._connection.serial})"
        self.opened += 1

    def _set_up(self) -> None:
        assert self._connection is not None
        setup = AravisSetup(self._connection, self._settings, self._shape, self.name)
        setup.stop()
        self._drop_stream()
        setup.set_image()
        payload = setup.payload()
        self._stream = setup.make_stream(payload)
        setup.set_trigger()
        self._exposure_s = setup.check()
        self.frame_numbers = setup.frame_numbers()
        self._packet_bytes = setup.packet_bytes
        self._hint = receive_buffer_problem(payload) if self._connection.is_gige else ""
        if self._hint:
            _log.warning("%s: %s", self.name, self._hint)
        setup.start()
        self._drain()

    def _drain(self) -> None:
        """Drop frames from before: those that a free run left would pass for triggered ones."""
        library, give_up = aravis(), time.monotonic() + sfnc.MOST_DRAINING_S
        while time.monotonic() < give_up:
            buffer = library("arv_stream_timeout_pop_buffer", self._stream, int(1e6 * sfnc.QUIET_S))
            if buffer is None:
                return
            library("arv_stream_push_buffer", self._stream, buffer)

    def _read(self, library: AravisLibrary, buffer: int, serial: str) -> Frame | BrokenFrame:
        """The frame in a buffer. Of one that is not whole, number and time may be those of an earlier frame.

        Raises:
            LostShotError: `Reason.CAMERA_GONE`: it is not as this camera was set up, which is to be done again.
        """
        status = library("arv_buffer_get_status", buffer)
        if status == SIZE_MISMATCH:
            raise self._changed(BUFFER_STATUS[status], "no more than its PayloadSize")
        if status != SUCCESS:
            return BrokenFrame(self._explained(BUFFER_STATUS.get(status, f"status {status}")))
        rows, columns = self._shape
        expected = (columns, rows, pixel_format(self._settings.pixel_format).code)
        got = tuple(library(f"arv_buffer_get_image_{what}", buffer) for what in ("width", "height", "pixel_format"))
        if got != expected:
            told, wanted = (f"{each[0]} x {each[1]} pixels in format {each[2]:#010x}" for each in (got, expected))
            raise self._changed(told, wanted)
        name = self._settings.pixel_format
        try:
            raw = without_padding(_bytes(library, buffer), self._shape, name, _padding(library, buffer))
            pixels = unpack(raw, self._shape, name)
        except FrameError as error:
            return BrokenFrame(f"{error.got} in place of {error.expected}")
        info = FrameInfo(
            serial=serial,
            frame_id=library("arv_buffer_get_frame_id", buffer),
            device_time_s=1e-9 * library("arv_buffer_get_timestamp", buffer),
            host_time_s=1e-9 * library("arv_buffer_get_system_timestamp", buffer),
            pixel_format=name,
            exposure_s=self._exposure_s,
        )
        return Frame(pixels, info)

    def _explained(self, detail: str) -> str:
        if self._hint:
            return f"{detail}; {self._hint}"
        if self._packet_bytes and not self.whole_frames:
            asked = f"does the network carry packets of {self._packet_bytes} bytes?"
            return f"{detail}; no frame has come whole yet: {asked}"
        return detail

    def _armed(self) -> tuple[AravisConnection, int]:
        if self._connection is None or self._stream is None:
            raise self._unarmed(self._connection is not None)
        if self._connection.control_lost:
            raise self._lose("control of it is lost")
        return self._connection, self._stream

    @contextmanager
    def _answering(self) -> Iterator[None]:
        """Turn the silence of the camera into its loss."""
        try:
            yield
        except AravisError as error:
            if says_gone(error):
                raise self._lose(error.message) from None
            raise SourceError(self.name, error.message, "no error") from None

    def _changed(self, got: str, expected: str) -> LostShotError:
        """The error of a camera that is not set up any more as it was."""
        return LostShotError(f"{self.name}: frame, as after a change of settings", got, expected, Reason.CAMERA_GONE)

    def _lose(self, got: str) -> LostShotError:
        self._release(gone=True)
        return self._gone(got)

    def _release(self, gone: bool) -> None:
        """Let go of stream and camera."""
        stream = self._take_stream()
        if self._connection is not None:
            connection, self._connection = self._connection, None
            connection.close(stream, gone)

    def _drop_stream(self) -> None:
        if (stream := self._take_stream()) is not None:
            aravis().unref(stream)

    def _take_stream(self) -> int | None:
        """The stream, which is no longer this camera's; its count of frames stays."""
        self._earlier = self.whole_frames
        stream, self._stream = self._stream, None
        return stream


def _bytes(library: AravisLibrary, buffer: int) -> NDArray[np.uint8]:
    """All that came into a buffer, in place."""
    size = ctypes.c_size_t()
    place = library("arv_buffer_get_data", buffer, ctypes.byref(size))
    return np.ctypeslib.as_array((ctypes.c_uint8 * size.value).from_address(place))


def _padding(library: AravisLibrary, buffer: int) -> int:
    """Bytes behind each line of pixels; earlier versions of the library do not tell, and take them for none."""
    columns, rows = ctypes.c_int(), ctypes.c_int()
    if library.knows("arv_buffer_get_image_padding"):
        library("arv_buffer_get_image_padding", buffer, ctypes.byref(columns), ctypes.byref(rows))
    return columns.value
