"""Cameras of any kind that their maker has a GenTL producer for, each in a process of its own."""

from __future__ import annotations

import mmap
import os
import time

import numpy as np
from pydantic import ValidationError

from lightpage.errors import LostShotError, Reason, SourceError
from lightpage.helper_process import HelperProcess
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.device.cameras.camera import Frame, FrameStatus
from lightpage.runtime.device.cameras.gentl_link import Answer, Arrived, Do, Ready, Request, Task
from lightpage.runtime.device.cameras.pixel_formats import bit_depth, pixel_format, unpack
from lightpage.runtime.device.cameras.settings import CameraSettings

_PROCESS = "lightpage.runtime.device.cameras.gentl_process"
_OPEN_S = 30.0
"""Time to load the producer and to find and open the camera."""
COMMAND_S = 10.0
"""Time for an answer; producers wait for seconds for a camera that is gone."""
_CLOSE_S = 3.0


class GenTLCamera:
    """A camera of `lightpage.runtime.device.cameras.camera.Camera`.

    Args:
        settings: which one, by its producer and serial number, and how it is set up.
        frame_shape: (rows, columns) of the region that is read.
        role: for people, e.g. ``in-phase camera``.
    """

    def __init__(self, settings: CameraSettings, frame_shape: tuple[int, int], role: str = "camera") -> None:
        self._settings, self._shape, self._role = settings, frame_shape, role
        self._process: HelperProcess | None = None
        self._memory: mmap.mmap | None = None
        self._ready: Ready | None = None
        self._number = self._opened = 0

    @property
    def name(self) -> str:
        """See `Camera`."""
        return f"{self._role} ({self._settings.label})"

    @property
    def frame_shape(self) -> tuple[int, int]:
        """See `Camera`."""
        return self._shape

    @property
    def bit_depth(self) -> int:
        """See `Camera`."""
        return bit_depth(self._settings.pixel_format)

    @property
    def frame_numbers(self) -> int:
        """See `Camera`."""
        return 2**64 - 1 if self._ready is None else self._ready.frame_numbers

    @property
    def opened(self) -> int:
        """See `Camera`."""
        return self._opened

    def arm(self) -> None:
        """See `Camera`."""
        if self._process is not None and self._process.ended():
            self._release()
        if self._process is None:
            self._open()
        self._ready = None
        self._ready = self._ask(Do.ARM).ready

    def fire(self) -> None:
        """See `Camera`."""
        self._armed()
        self._ask(Do.FIRE)

    def frame(self, timeout_s: float) -> Frame | None:
        """See `Camera`."""
        ready = self._armed()
        arrived = self._ask(Do.FRAME, timeout_s).arrived
        if arrived is None:
            return None
        if arrived.fault:
            return Frame(FrameStatus.INCOMPLETE, detail=arrived.fault)
        return self._frame(ready, arrived)

    def disarm(self) -> None:
        """See `Camera`."""
        if self._process is None or self._ready is None:
            return
        self._ready = None
        try:
            self._ask(Do.DISARM)
        except (LostShotError, SourceError):
            self._release()

    def close(self) -> None:
        """See `Camera`."""
        self._release()

    def _open(self) -> None:
        before = self._opened
        rows, columns = self._shape
        size = pixel_format(self._settings.pixel_format).nbytes(rows * columns)
        try:
            # Without a name: whatever ends either process, nothing of it is left.
            descriptor = os.memfd_create("lightpage-frame")
            try:
                os.truncate(descriptor, size)
                self._memory = mmap.mmap(descriptor, size)
                task = Task(
                    settings=self._settings, frame_shape=self._shape, memory=descriptor, memory_bytes=size
                ).model_dump_json(exclude_unset=True)
                self._process = HelperProcess(_PROCESS, task, files=[descriptor], subject="its process")
            finally:
                os.close(descriptor)
            opening = Answer.model_validate_json(self._process.line(time.monotonic() + _OPEN_S))
        except (OSError, ValidationError) as error:
            self._release()
            raise self._absent(before, str(error) or f"no word within {_OPEN_S:g} s", "one that opens it") from None
        if (failure := opening.failure) is not None:
            self._release()
            raise self._absent(before, failure.got, failure.expected, failure.setting)
        self._opened = before + 1

    def _absent(self, before: int, got: str, expected: str, setting: str = "") -> SourceError | LostShotError:
        """The error of a camera that is not there: it has gone away only if it was there."""
        subject = f"{self.name}: {setting}" if setting else self.name
        if before:
            return LostShotError(subject, got, expected, Reason.CAMERA_GONE)
        return SourceError(subject, got, expected)

    def _armed(self) -> Ready:
        if self._ready is None:
            before = self._opened if self._process is None else 0
            raise self._absent(before, "a camera that is not armed", "`arm` before it is used")
        return self._ready

    def _ask(self, do: Do, timeout_s: float = 0.0) -> Answer:
        """Have the process do something.

        Raises:
            SourceError: the camera refuses.
            LostShotError: it, or its process, has gone.
        """
        assert self._process is not None  # of a camera that is open
        self._number += 1
        deadline = time.monotonic() + timeout_s + COMMAND_S
        try:
            self._process.send(Request(number=self._number, do=do, timeout_s=timeout_s).to_line(), deadline)
            answer = Answer.model_validate_json(self._process.line(deadline))
        except TimeoutError:
            raise self._lose(f"no answer within {timeout_s + COMMAND_S:g} s") from None
        except (OSError, ValidationError) as error:
            raise self._lose(str(error)) from None
        if answer.number != self._number:
            raise self._lose(f"an answer to request {answer.number} in place of {self._number}")
        if (failure := answer.failure) is None:
            return answer
        if failure.gone:
            raise self._lose(failure.got)
        subject = f"{self.name}: {failure.setting}" if failure.setting else self.name
        raise SourceError(subject, failure.got, failure.expected)

    def _frame(self, ready: Ready, arrived: Arrived) -> Frame:
        assert self._memory is not None  # of a camera that is open
        info = FrameInfo(
            serial=ready.serial,
            frame_id=arrived.frame_id,
            device_time_s=arrived.device_time_s,
            host_time_s=arrived.host_time_s,
            pixel_format=self._settings.pixel_format,
            exposure_s=ready.exposure_s,
        )
        raw = np.frombuffer(self._memory, np.uint8)
        return Frame(FrameStatus.COMPLETE, unpack(raw, self._shape, self._settings.pixel_format), info)

    def _lose(self, got: str) -> LostShotError:
        self._release()
        return LostShotError(self.name, got, "a camera that answers", Reason.CAMERA_GONE)

    def _release(self) -> None:
        """End the process, which lets go of the camera."""
        process, self._process, self._memory, self._ready = self._process, None, None, None
        if process is not None:
            process.end(_CLOSE_S)
