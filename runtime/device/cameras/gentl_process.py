"""The process of one GenTL camera, started by `gentl` with a TASK and a socket on its stdin.

Producers are libraries of camera makers, and harvesters, which drives them, holds the interpreter while it waits for a
frame. Neither is to happen in the process that serves. It ends when the socket's other end does.
"""

from __future__ import annotations

import logging
import mmap
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from lightpage.errors import FrameError
from lightpage.helper_process import parent_link
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.device.cameras import sfnc
from lightpage.runtime.device.cameras.gentl_link import Answer, Do, Failure, Request, Task
from lightpage.runtime.device.cameras.pixel_formats import pixel_format, without_padding

_FAREWELL_S = 2.0
"""A producer that does not let go of its camera for so long is left as it is."""
_LEAST_WAIT_S = 1e-3
"""harvesters waits without end for 0."""
_READABLE = 3
"""GenApi's access modes from here on: RO, RW."""
_EXPOSURES = ("ExposureTime", "ExposureTimeAbs")
"""Today's name, and that of cameras from before SFNC 2.0."""


class CameraError(Exception):
    """The camera, its producer or this machine does not do what is asked for, or does not answer.

    Attributes:
        failure: what is told of it.
    """

    def __init__(self, setting: str, got: object, expected: object, gone: bool = False) -> None:
        super().__init__(setting, got, expected)
        self.failure = Failure(gone=gone, setting=setting, got=str(got), expected=str(expected))


class GenTLDevice:
    """One open camera.

    Args:
        task: which one, and how it is set up.

    Raises:
        CameraError: there is no such producer or camera, or another program has it.
    """

    def __init__(self, task: Task) -> None:
        try:
            from genicam import genapi, gentl
            from harvesters.core import Harvester
        except ImportError as error:
            raise CameraError("driver", error, "the camera extra: pip install 'lightpage[camera]'") from None
        logging.getLogger("harvesters").disabled = True  # what it says is in the error, once
        for name in list(logging.Logger.manager.loggerDict):
            if name.startswith("harvesters."):
                logging.getLogger(name).disabled = True
        self._settings, self._shape = task.settings, task.frame_shape
        self._errors: tuple[type[Exception], ...] = (gentl.GenericException, genapi.GenericException)
        self._refusals = (OSError, AttributeError, ValueError, *self._errors)
        self._incomplete = 0
        self._acquirer: Any = None
        self._harvester = Harvester()
        producer = self._settings.producer
        try:
            self._harvester.add_file(producer, check_existence=True, check_validity=True)
            self._harvester.update()
            found = {info.serial_number or info.id_: info for info in self._harvester.device_info_list}
        except self._refusals as error:
            raise CameraError("producer", f"{producer}: {_plain(error)}", "one that can be loaded") from None
        self._serial = self._settings.label
        if self._serial not in found:
            raise CameraError("serial", self._serial, f"one of {', '.join(found) or 'no camera at all'}")
        try:
            self._acquirer = self._harvester.create(found[self._serial])
        except self._errors as error:
            raise CameraError("camera", _plain(error), "one that no other program has open") from None
        self._acquirer.add_callback(self._acquirer.Events.INCOMPLETE_BUFFER, _calling(self._count_incomplete))
        self._nodes = self._acquirer.remote_device.node_map

    def arm(self) -> int:
        """Set it up, start it, and drop frames from before; returns the number of a frame after which comes 1.

        Raises:
            CameraError: it does not take a setting.
        """
        settings = self._settings
        with self._setting("acquisition", "stopped"):
            self._acquirer.stop()
        for selector in (*sfnc.OTHER_SELECTORS, *sfnc.FRAME_SELECTORS):
            if selector in self._entries("TriggerSelector"):
                self._set("TriggerSelector", selector)
                self._set("TriggerMode", "Off")
        if not self._entries("TriggerSelector"):
            self._set("TriggerMode", "Off")
        self._set("AcquisitionMode", "Continuous")
        for feature, off in {**dict.fromkeys(sfnc.SWITCHED_OFF, False), **dict.fromkeys(sfnc.AUTOMATIC, "Off")}.items():
            if self._has(feature):
                self._set(feature, off)
        rows, columns = self._shape
        self._set("PixelFormat", settings.pixel_format)
        for feature in ("OffsetX", "OffsetY"):  # out of the way of a larger region
            if self._has(feature):
                self._set(feature, 0)
        self._set("Width", columns)
        self._set("Height", rows)
        for feature, offset in (("OffsetX", settings.offset_x_px), ("OffsetY", settings.offset_y_px)):
            if offset:
                self._set(feature, offset)
        self._exposure_s = self._set_exposure()
        if settings.gain_db is not None:
            self._set("Gain", settings.gain_db, "gain_db")
        if settings.black_level_counts is not None:
            self._set("BlackLevel", settings.black_level_counts, "black_level_counts")
        least = pixel_format(settings.pixel_format).nbytes(rows * columns)
        with self._setting("PayloadSize", least):
            payload = self._nodes.PayloadSize.get_value(False, True)
        if payload < least:  # what the camera adds to the pixels is left out
            raise self._refused("PayloadSize", f"{least} or more", "PayloadSize", payload, "")
        selectors = self._entries("TriggerSelector")
        trigger = sfnc.trigger_features(settings, selectors, self._has("TriggerActivation"))
        for feature, value in trigger.items():  # last of all, for some settings switch it off again
            self._set(feature, value)
        for feature, value in {**trigger, "PixelFormat": settings.pixel_format}.items():
            self._check(feature, value)
        with self._setting("buffers", settings.buffers):
            self._acquirer.num_buffers = max(settings.buffers, self._acquirer.min_num_buffers)
        with self._setting("acquisition", "started"):
            self._acquirer.start()
        self._drain()
        extended = self._has("GevGVSPExtendedIDMode") and self._nodes.GevGVSPExtendedIDMode.value == "On"
        return sfnc.frame_numbers(self._acquirer.device.tl_type == "GEV", extended)

    def fire(self) -> None:
        """Trigger it by a command.

        Raises:
            CameraError: it does not answer.
        """
        with self._answering():
            self._nodes.TriggerSoftware.execute()

    def frame(self, timeout_s: float, memory: mmap.mmap) -> str | FrameInfo | None:
        """The next frame, whose bytes are put into `memory`; why it is not whole; or None where none comes.

        Raises:
            CameraError: it does not answer, or its producer knows no time of a frame.
        """
        self._incomplete = 0
        with self._answering():
            buffer = self._acquirer.try_fetch(timeout=max(timeout_s, _LEAST_WAIT_S), is_raw=True)
            if buffer is None and self._incomplete:
                return "parts of it are missing"
            if buffer is None:
                if timeout_s >= sfnc.SIGN_OF_LIFE_S:
                    self._nodes.TriggerMode.get_value(False, True)
                return None
            try:
                return self._read(buffer, memory)
            finally:
                buffer.parent.queue_buffer(buffer)

    def disarm(self) -> None:
        """Stop taking frames.

        Raises:
            CameraError: it does not answer.
        """
        with self._answering():
            self._acquirer.stop()

    def close(self) -> None:
        """Let go of it."""
        with suppress(*self._errors):
            if self._acquirer is not None:
                self._acquirer.destroy()
            self._harvester.reset()

    def _count_incomplete(self) -> None:
        """Called by harvesters, which drops frames that are not whole."""
        self._incomplete += 1

    def _read(self, buffer: Any, memory: mmap.mmap) -> str | FrameInfo:
        """What is in a complete buffer.

        Raises:
            CameraError: something else than it was set up for; it is to be opened again.
        """
        arrived_s = time.time()
        known = pixel_format(self._settings.pixel_format)
        rows, columns = self._shape
        got = (buffer.width, buffer.height, buffer.pixel_format)
        if got != (columns, rows, known.code):
            told = f"{got[0]} x {got[1]} pixels in format {got[2]:#010x}"
            raise _gone(f"{told} in place of {columns} x {rows} in {known.code:#010x}")
        try:
            sent = pixel_bytes(buffer, self._shape, known.name, self._errors)
        except FrameError as error:
            return f"{error.got} in place of {error.expected}"
        memory[: len(sent)] = sent
        return FrameInfo(
            serial=self._serial,
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
        raise CameraError("producer", "no time of a frame", "one: frames cannot be told apart without it")

    def _set_exposure(self) -> float | None:
        """Exposure time as read back, seconds; None of a camera that knows none and was not asked for one."""
        wanted = self._settings.exposure_us
        feature = next((name for name in _EXPOSURES if self._has(name)), None)
        if feature is None:
            if "exposure_us" in self._settings.model_fields_set:
                raise CameraError("exposure_us", wanted, "no such key: the camera knows no exposure time")
            return None
        return 1e-6 * float(self._set(feature, wanted, "exposure_us"))

    def _drain(self) -> None:
        """Drop frames from before: those that a free run left would pass for triggered ones."""
        give_up = time.monotonic() + sfnc.MOST_DRAINING_S
        with self._setting("acquisition", "started"):
            while time.monotonic() < give_up:
                buffer = self._acquirer.try_fetch(timeout=sfnc.QUIET_S, is_raw=True)
                if buffer is None:
                    return
                buffer.parent.queue_buffer(buffer)

    def _has(self, feature: str) -> bool:
        with suppress(*self._errors):
            return bool(self._nodes.has_node(feature)) and getattr(self._nodes, feature).get_access_mode() >= _READABLE
        return False

    def _entries(self, feature: str) -> tuple[str, ...]:
        return tuple(getattr(self._nodes, feature).symbolics) if self._has(feature) else ()

    def _set(self, feature: str, value: Any, key: str = "") -> Any:
        """Give it a setting, unless it has it; returns the value that it keeps, which must be the one asked for."""
        setting = key or feature
        with self._setting(setting, value, feature):
            if not self._nodes.has_node(feature):
                subject = sfnc.KEYS.get(setting, setting)
                raise CameraError(subject, value, "no such key: the camera does not know it")
            node = getattr(self._nodes, feature)
            if node.value != value:
                node.value = value
        return self._check(feature, value, key)

    def _check(self, feature: str, value: Any, key: str = "") -> Any:
        """Read it back from the camera itself: cameras round, clip and ignore what they get."""
        with self._setting(key or feature, value):
            got = getattr(self._nodes, feature).get_value(False, True)
        if (abs(got - value) > sfnc.tolerance(key, value)) if key else got != value:
            raise self._refused(key or feature, value, feature, got, "")
        return got

    @contextmanager
    def _setting(self, setting: str, expected: object, feature: str = "") -> Iterator[None]:
        """Name the setting that the camera refuses."""
        try:
            yield
        except self._refusals as error:
            raise self._refused(setting, expected, feature, None, _plain(error)) from None

    def _refused(self, setting: str, asked: object, feature: str, kept: object, told: str) -> CameraError:
        return CameraError(*sfnc.refusal(setting, asked, kept, told, lambda: self._offers(feature)))

    def _offers(self, feature: str) -> str:
        """Entries or limits of a feature, empty where it tells none."""
        with suppress(*self._refusals):
            if entries := self._entries(feature):
                return sfnc.one_of(entries)
            node = getattr(self._nodes, feature)
            return f"{sfnc.between(node.min, node.max)}, in its steps"
        return ""

    @contextmanager
    def _answering(self) -> Iterator[None]:
        """Turn the silence of the camera into its loss."""
        try:
            yield
        except self._errors as error:
            raise _gone(_plain(error)) from None


def pixel_bytes(buffer: Any, shape: tuple[int, int], name: str, unknown: tuple[type[Exception], ...]) -> bytes:
    """The bytes of a buffer's pixels, without what is before, between and behind them.

    Args:
        buffer: of harvesters.
        shape: (rows, columns).
        name: of the pixel format.
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


def _gone(got: str) -> CameraError:
    """The error of a camera that is no longer there as it was."""
    return CameraError("", got, "a camera that answers", gone=True)


def _plain(error: BaseException) -> str:
    """GenApi's messages without the place in its sources; what harvesters does not say."""
    if isinstance(error, FileNotFoundError) and not str(error):
        return "no such file"
    if isinstance(error, OSError) and not str(error):
        return "a file that cannot be loaded"
    return str(error).split(" : ", 1)[0].removeprefix("GenTL exception: ").split(" (Message from", 1)[0] or repr(error)


def main(task_json: str) -> int:
    """Do what comes over the socket until its other end is closed."""
    task = Task.model_validate_json(task_json)
    with parent_link() as link, mmap.mmap(task.memory, 0) as memory:
        try:
            device = GenTLDevice(task)
        except CameraError as error:
            link.sendall(Answer(number=0, failure=error.failure).to_line())
            return 1
        try:
            link.sendall(Answer(number=0).to_line())
            with link.makefile("rb") as stream:
                for line in stream:
                    link.sendall(_answer(device, Request.model_validate_json(line), memory).to_line())
        except OSError:
            pass  # the other end is closed
        finally:
            _say_farewell(device)
    return 0


def _answer(device: GenTLDevice, request: Request, memory: mmap.mmap) -> Answer:
    number = request.number
    try:
        if request.do is Do.ARM:
            return Answer(number=number, frame_numbers=device.arm())
        if request.do is Do.FRAME:
            found = device.frame(request.timeout_s, memory)
            return Answer(number=number, fault=found) if isinstance(found, str) else Answer(number=number, info=found)
        if request.do is Do.FIRE:
            device.fire()
        else:
            device.disarm()
    except CameraError as error:
        return Answer(number=number, failure=error.failure)
    return Answer(number=number)


def _say_farewell(device: GenTLDevice) -> None:
    """Let go of the camera; a producer that hangs is not waited for."""
    last_call = threading.Timer(_FAREWELL_S, os._exit, (1,))
    last_call.daemon = True
    last_call.start()
    device.close()
    last_call.cancel()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
