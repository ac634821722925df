"""Cameras of any kind that their maker has a GenTL producer for, each in a process of its own."""

from __future__ import annotations

import mmap
import os
import time

import numpy as np
from pydantic import ValidationError

from lightpage.errors import LostShotError, Reason, SourceError
from lightpage.helper_process import HelperProcess
from lightpage.runtime.device.cameras.camera import BrokenFrame, DrivenCamera, Frame
from lightpage.runtime.device.cameras.gentl_link import Answer, Do, Request, Task
from lightpage.runtime.device.cameras.pixel_formats import pixel_format, unpack
from lightpage.runtime.device.cameras.settings import CameraSettings

_PROCESS = "lightpage.runtime.device.cameras.gentl_process"
_OPEN_S = 30.0
"""Time to load the producer and to find and open the camera."""
COMMAND_S = 10.0
"""Time for an answer; producers wait for seconds for a camera that is gone."""
_CLOSE_S = 3.0


class GenTLCamera(DrivenCamera):
    """A camera of `lightpage.runtime.device.cameras.camera.Camera`; see `DrivenCamera` for its arguments."""

    def __init__(self, settings: CameraSettings, frame_shape: tuple[int, int], role: str = "camera") -> None:
        super().__init__(settings, frame_shape, role)
        self._process: HelperProcess | None = None
        self._memory: mmap.mmap | None = None
        self._armed = False
        self._number = 0

    def arm(self) -> None:
        """See `Camera`."""
        if self._process is not None and self._process.ended():
            self.close()
        if self._process is None:
            self._open()
        self._armed = False
        self.frame_numbers = self._ask(Do.ARM).frame_numbers
        self._armed = True

    def fire(self) -> None:
        """See `Camera`."""
        self._check_armed()
        self._ask(Do.FIRE)

    def frame(self, timeout_s: float) -> Frame | BrokenFrame | None:
        """See `Camera`."""
        self._check_armed()
        answer = self._ask(Do.FRAME, timeout_s)
        if answer.fault:
            return BrokenFrame(answer.fault)
        if answer.info is None:
            return None
        assert self._memory is not None  # of a camera that is open
        raw = np.frombuffer(self._memory, np.uint8)
        return Frame(unpack(raw, self._shape, self._settings.pixel_format), answer.info)

    def disarm(self) -> None:
        """See `Camera`."""
        if not self._armed:
            return
        self._armed = False
        try:
            self._ask(Do.DISARM)
        except (LostShotError, SourceError):
            self.close()

    def close(self) -> None:
        """See `Camera`: ends the process, which lets go of the camera."""
        process, self._process, self._memory, self._armed = self._process, None, None, False
        if process is not None:
            process.end(_CLOSE_S)

    def _open(self) -> None:
        rows, columns = self._shape
        size = pixel_format(self._settings.pixel_format).nbytes(rows * columns)
        try:
            # Without a name: whatever ends either process, nothing of it is left.
            with os.fdopen(os.memfd_create("lightpage-frame"), "r+b", buffering=0) as memory:
                memory.truncate(size)
                self._memory = mmap.mmap(memory.fileno(), size)
                task = Task(settings=self._settings, frame_shape=self._shape, memory=memory.fileno())
                told = task.model_dump_json(exclude_unset=True)
                self._process = HelperProcess(_PROCESS, told, files=[memory.fileno()], subject="its process")
            opening = Answer.model_validate_json(self._process.line(time.monotonic() + _OPEN_S))
        except (OSError, ValidationError) as error:
            self.close()
            told = str(error) or f"no word within {_OPEN_S:g} s"
            raise self._absent(self.opened > 0, told, "one that opens it") from None
        if (failure := opening.failure) is not None:
            self.close()
            raise self._absent(self.opened > 0, failure.got, failure.expected, failure.setting)
        self.opened += 1

    def _check_armed(self) -> None:
        if not self._armed:
            raise self._unarmed(self._process is not None)

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
        raise self._absent(False, failure.got, failure.expected, failure.setting)

    def _lose(self, got: str) -> LostShotError:
        self.close()
        return LostShotError(self.name, got, "a camera that answers", Reason.CAMERA_GONE)
