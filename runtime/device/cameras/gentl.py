"""Cameras of any kind that their maker has a GenTL producer for, each in a process of its own."""

import mmap
import os
from typing import Any

import numpy as np

from lightpage.errors import LostShotError, SourceError, WorkerError
from lightpage.helper_process import HelperProcess
from lightpage.recording.layout import FrameInfo
from lightpage.runtime.device.cameras.camera import BrokenFrame, DrivenCamera, Frame
from lightpage.runtime.device.cameras.pixel_formats import pixel_format, unpack
from lightpage.runtime.device.cameras.settings import CameraSettings

_PROCESS = "lightpage.runtime.device.cameras.gentl_process:GenTLDevice"
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

    def arm(self) -> None:
        """See `Camera`."""
        if self._process is not None and self._process.ended():
            self.close()
        if self._process is None:
            self._open()
        self._armed = False
        self.frame_numbers = self._ask("arm")
        self._armed = True

    def fire(self) -> None:
        """See `Camera`."""
        self._check_armed()
        self._ask("fire")

    def frame(self, timeout_s: float) -> Frame | BrokenFrame | None:
        """See `Camera`."""
        self._check_armed()
        found: FrameInfo | BrokenFrame | None = self._ask("frame", timeout_s, timeout_s=timeout_s)
        if not isinstance(found, FrameInfo):
            return found
        assert self._memory is not None  # of a camera that is open
        raw = np.frombuffer(self._memory, np.uint8)
        return Frame(unpack(raw, self._shape, self._settings.pixel_format), found)

    def disarm(self) -> None:
        """See `Camera`."""
        if not self._armed:
            return
        self._armed = False
        try:
            self._ask("disarm")
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
                self._process = HelperProcess(_PROCESS, files=[memory.fileno()], subject=self.name)
                # of a table that wires a device, what else it says is not the camera's
                given = self._settings.model_dump(include=set(CameraSettings.model_fields), exclude_unset=True)
                task = self.name, CameraSettings.model_validate(given), self._shape, memory.fileno()
                self._process.ask("open", *task, timeout_s=_OPEN_S)
        except (OSError, SourceError, WorkerError) as error:
            self.close()
            if isinstance(error, SourceError) and not self.opened:
                raise
            raise self._absent(self.opened > 0, getattr(error, "got", error), "one that opens it") from None
        self.opened += 1

    def _check_armed(self) -> None:
        if not self._armed:
            raise self._unarmed(self._process is not None)

    def _ask(self, what: str, *arguments: Any, timeout_s: float = 0.0) -> Any:
        """Have the process do something.

        Raises:
            SourceError: the camera refuses.
            LostShotError: it, or its process, has gone.
        """
        assert self._process is not None  # of a camera that is open
        try:
            return self._process.ask(what, *arguments, timeout_s=timeout_s + COMMAND_S)
        except (LostShotError, WorkerError) as error:
            self.close()
            raise self._gone(error.got) from None
