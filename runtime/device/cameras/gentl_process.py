"""The process of one GenTL camera, which `gentl` starts.

Producers are libraries of camera makers, and harvesters, which drives them, holds the interpreter while it waits for a
frame. Neither is to happen in the process that serves.
"""

import logging
import mmap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from lightpage.errors import FrameError, LostShotError, Reason, SourceError
from lightpage.helper_process import Helper
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.device.cameras import sfnc
from lightpage.runtime.device.cameras.camera import BrokenFrame
from lightpage.runtime.device.cameras.pixel_formats import pixel_format, without_padding
from lightpage.runtime.device.cameras.settings import CameraSettings

_LEAST_WAIT_S = 1e-3
"""harvesters waits without end for 0."""
_READABLE = 3
"""GenApi's access modes from here on: RO, RW."""
_FEATURES = {
    "exposure_us": ("ExposureTime", "ExposureTimeAbs"),
    "gain_db": ("Gain",),
    "black_level_counts": ("BlackLevel",),
}
"""What is set by a key: today's name, and that of cameras from before SFNC 2.0."""


class GenTLSetup(sfnc.CameraSetup):
    """See `CameraSetup`.

    Args:
        nodes: GenApi's, of the camera.
        refusals: what they raise.
        settings, frame_shape, name, is_gige: see `CameraSetup`.
    """

    def __init__(
        self,
        nodes: Any,
        refusals: tuple[type[Exception], ...],
        settings: CameraSettings,
        frame_shape: tuple[int, int],
        name: str,
        is_gige: bool,
    ) -> None:
        super().__init__(settings, frame_shape, name, is_gige)
        self._nodes, self.refusals = nodes, refusals

    def set_region(self) -> None:
        """See `CameraSetup`; the old region's corner is put out of the way of a larger one first."""
        corner = {"OffsetX": self.region.x, "OffsetY": self.region.y}
        size = {"Width": self.region.columns, "Height": self.region.rows}
        for feature, value in {**dict.fromkeys(filter(self.has, corner), 0), **size}.items():
            self.set(feature, value)
        for feature, value in corner.items():
            if value:
                self.set(feature, value)

    def has(self, feature: str) -> bool:
        """See `CameraSetup`."""
        return self._node(feature) is not None

    def entries(self, feature: str) -> list[str]:
        """See `CameraSetup`."""
        return list(self._node(feature).symbolics)

    def write(self, feature: str, value: Any) -> None:
        """See `CameraSetup`: what it has already is not set again."""
        if (node := self._node(feature)) is None:
            subject = f"{self.name}: {sfnc.KEYS.get(feature, feature)}"
            raise SourceError(subject, value, "no such key: the camera does not know it")
        if node.value != value:
            node.value = value

    def read(self, feature: str, kind: type) -> Any:
        """See `CameraSetup`."""
        return self._node(feature).get_value(False, True)

    def limits(self, feature: str) -> str:
        """See `CameraSetup`."""
        node = self._node(feature)
        return sfnc.between(node.min, node.max)

    def told(self, error: Exception) -> str:
        """See `CameraSetup`."""
        return _plain(error)

    def _node(self, feature: str) -> Any:
        """The node of a feature or key, or None where the camera has none that can be read."""
        for name in _FEATURES.get(feature, (feature,)):
            with suppress(*self.refusals):
                if self._nodes.has_node(name) and (node := getattr(self._nodes, name)).get_access_mode() >= _READABLE:
                    return node
        return None


class GenTLDevice(Helper):
    """A camera under GenTL. Where it does not answer, each method raises `LostShotError`, `Reason.CAMERA_GONE`."""

    farewell_s = 2.0
    """A producer that does not let go of its camera for so long is left as it is."""

    def __init__(self) -> None:
        self._incomplete = 0
        self._errors: tuple[type[Exception], ...] = ()
        self._harvester: Any = None
        self._acquirer: Any = None
        self._exposure_s: float | None = None

    def open(self, name: str, settings: CameraSettings, frame_shape: tuple[int, int], memory: int) -> None:
        """Open the camera.

        Args:
            name: name of the camera, for errors.
            settings: which one, and how it is set up.
            frame_shape: (rows, columns) of the region that is read.
            memory: file descriptor of the shared memory that takes one frame as the camera packs it.

        Raises:
            SourceError: there is no such producer or camera, or another program has it.
        """
        self._name, self._settings, self._shape = name, settings, frame_shape
        self._memory = mmap.mmap(memory, 0)
        try:
            from genicam import genapi, gentl
            from harvesters.core import Harvester
        except ImportError as error:
            raise SourceError(f"{name}: driver", error, "the camera extra: pip install 'lightpage[camera]'") from None
        logging.getLogger("harvesters").disabled = True  # what it says is in the error, once
        for logger in list(logging.Logger.manager.loggerDict):
            if logger.startswith("harvesters."):
                logging.getLogger(logger).disabled = True
        self._errors = (gentl.GenericException, genapi.GenericException)
        self._refusals = (OSError, AttributeError, ValueError, *self._errors)
        self._harvester = Harvester()
        producer, serial = settings.producer, settings.label
        try:
            self._harvester.add_file(producer, check_existence=True, check_validity=True)
            self._harvester.update()
            found = {info.serial_number or info.id_: info for info in self._harvester.device_info_list}
        except self._refusals as error:
            got = f"{producer}: {_plain(error)}"
            raise SourceError(f"{name}: producer", got, "one that can be loaded") from None
        if serial not in found:
            raise SourceError(f"{name}: serial", serial, f"one of {', '.join(found) or 'no camera at all'}")
        try:
            self._acquirer = self._harvester.create(found[serial])
        except self._errors as error:
            raise SourceError(f"{name}: camera", _plain(error), "one that no other program has open") from None
        self._acquirer.add_callback(self._acquirer.Events.INCOMPLETE_BUFFER, _calling(self._count_incomplete))
        self._nodes = self._acquirer.remote_device.node_map

    def arm(self) -> int:
        """Set it up, start it, and drop frames from before; returns the number of a frame after which comes 1.

        Raises:
            SourceError: it does not take a setting.
        """
        is_gige = self._acquirer.device.tl_type == "GEV"
        setup = GenTLSetup(self._nodes, self._refusals, self._settings, self._shape, self._name, is_gige)
        with setup.setting("acquisition", "stopped"):
            self._acquirer.stop()
        setup.set_image()
        setup.payload()  # what the camera adds to the pixels is left out
        setup.set_trigger()
        self._exposure_s = setup.check()
        with setup.setting("buffers", self._settings.buffers):
            self._acquirer.num_buffers = max(self._settings.buffers, self._acquirer.min_num_buffers)
        with setup.setting("acquisition", "started"):
            self._acquirer.start()
            self._drain()
        return setup.frame_numbers()

    def fire(self) -> None:
        """Trigger it by a command."""
        with self._answering():
            self._nodes.TriggerSoftware.execute()

    def frame(self, timeout_s: float) -> BrokenFrame | FrameInfo | None:
        """The next frame, whose bytes are put into the shared memory; why it is not whole; or None where none comes.

        Raises:
            SourceError: its producer knows no time of a frame.
        """
        self._incomplete = 0
        with self._answering():
            buffer = self._acquirer.try_fetch(timeout=max(timeout_s, _LEAST_WAIT_S), is_raw=True)
            if buffer is None and self._incomplete:
                return BrokenFrame("parts of it are missing")
            if buffer is None:
                if timeout_s >= sfnc.SIGN_OF_LIFE_S:
                    self._nodes.TriggerMode.get_value(False, True)
                return None
            try:
                return self._read(buffer)
            finally:
                buffer.parent.queue_buffer(buffer)

    def disarm(self) -> None:
        """Stop taking frames."""
        with self._answering():
            self._acquirer.stop()

    def close(self) -> None:
        """Let go of it."""
        with suppress(*self._errors):
            if self._acquirer is not None:
                self._acquirer.destroy()
            if self._harvester is not None:
                self._harvester.reset()

    def _count_incomplete(self) -> None:
        """Called by harvesters, which drops frames that are not whole."""
        self._incomplete += 1

    def _read(self, buffer: Any) -> BrokenFrame | FrameInfo:
        """Return what is in a complete buffer.

        Raises:
            LostShotError: something else than it was set up for; it is to be opened again.
        """
        arrived_s = time.time()
        known = pixel_format(self._settings.pixel_format)
        rows, columns = self._shape
        got = (buffer.width, buffer.height, buffer.pixel_format)
        if got != (columns, rows, known.code):
            told = f"{got[0]} x {got[1]} pixels in format {got[2]:#010x}"
            raise self._gone(f"{told} in place of {columns} x {rows} in {known.code:#010x}")
        try:
            sent = pixel_bytes(buffer, self._shape, known.name, self._errors)
        except FrameError as error:
            return BrokenFrame(f"{error.got} in place of {error.expected}")
        self._memory[: len(sent)] = sent
        return FrameInfo(
            serial=self._settings.label,
            frame_id=buffer.frame_id,
            device_time_s=self._device_time_s(buffer),
            host_time_s=arrived_s,
            pixel_format=known.name,
            exposure_s=self._exposure_s,
        )

    def _device_time_s(self, buffer: Any) -> float:
        """Time of a frame by the camera's clock. Older producers give ticks, and say how long one is."""
        with suppress(*self._errors):
            return 1e-9 * float(buffer.timestamp_ns)
        with suppress(*self._errors, ZeroDivisionError):
            return float(buffer.timestamp) / float(self._acquirer.device.timestamp_frequency)
        expected = "one: frames cannot be told apart without it"
        raise SourceError(f"{self._name}: producer", "no time of a frame", expected)

    def _drain(self) -> None:
        """Drop frames from before: those that a free run left would pass for triggered ones."""
        give_up = time.monotonic() + sfnc.MOST_DRAINING_S
        while time.monotonic() < give_up:
            buffer = self._acquirer.try_fetch(timeout=sfnc.QUIET_S, is_raw=True)
            if buffer is None:
                return
            buffer.parent.queue_buffer(buffer)

    @contextmanager
    def _answering(self) -> Iterator[None]:
        """Turn the silence of the camera into its loss."""
        try:
            yield
        except self._errors as error:
            raise self._gone(_plain(error)) from None

    def _gone(self, got: str) -> LostShotError:
        return LostShotError(self._name, got, "a camera that answers", Reason.CAMERA_GONE)


def pixel_bytes(buffer: Any, shape: tuple[int, int], name: str, unknown: tuple[type[Exception], ...]) -> bytes:
    """The bytes of a buffer's pixels, without what is before, between and behind them.

    Args:
        buffer: buffer of harvesters.
        shape: (rows, columns).
        name: name of the pixel format.
        unknown: what a producer raises that does not tell an offset or a padding; then there is none.

    Raises:
        FrameError: too few bytes.
    """
    offset, padding, size = 0, 0, pixel_format(name).nbytes(shape[0] * shape[1])
    with suppress(*unknown):
        offset = buffer.image_offset
    with suppress(*unknown):
        padding = buffer.padding_x
    pixels = without_padding(np.frombuffer(buffer.raw_buffer, np.uint8)[offset:], shape, name, padding)
    if pixels.size < size:
        raise FrameError(f"frame in {name}", f"{pixels.size} bytes", str(size))
    return pixels[:size].tobytes()


def _calling(called: Callable[[], None]) -> Any:
    """A callback as harvesters wants it."""
    from harvesters.core import Callback

    class Call(Callback):  # type: ignore[misc]  # harvesters has no types
        def emit(self, context: object = None) -> None:
            called()

    return Call()


def _plain(error: BaseException) -> str:
    """GenApi's messages without the place in its sources; what harvesters does not say."""
    if isinstance(error, FileNotFoundError) and not str(error):
        return "no such file"
    if isinstance(error, OSError) and not str(error):
        return "a file that cannot be loaded"
    return str(error).split(" : ", 1)[0].removeprefix("GenTL exception: ").split(" (Message from", 1)[0] or repr(error)
