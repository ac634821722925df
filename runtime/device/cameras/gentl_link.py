"""What a GenTL camera and the process that has its producer say to each other: lines of JSON over a socket."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict

from lightpage.recording.layout import FrameInfo
from lightpage.runtime.device.cameras.settings import CameraSettings


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    def to_line(self) -> bytes:
        """As it is sent, the line's end included."""
        return self.model_dump_json().encode() + b"\n"


class Task(_Message):
    """What the process is for.

    Attributes:
        settings: of its camera.
        frame_shape: (rows, columns) of the region that is read.
        memory: file descriptor of the shared memory that takes one frame as the camera packs it.
    """

    settings: CameraSettings
    frame_shape: tuple[int, int]
    memory: int


class Do(StrEnum):
    """What the process can be asked for."""

    ARM = "ARM"
    """Set it up, or set it up anew; the answer has `frame_numbers`."""
    FIRE = "FIRE"
    FRAME = "FRAME"
    """The answer has `info` of a whole frame, which lies in the shared memory until the next request, or `fault` of one
    that is not whole, or neither where none came."""
    DISARM = "DISARM"


class Request(_Message):
    """One request; the next one follows its answer.

    Attributes:
        number: from 1.
        do: what.
        timeout_s: longest wait for a frame.
    """

    number: int
    do: Do
    timeout_s: float = 0.0


class Failure(_Message):
    """Why it was not done.

    Attributes:
        gone: the camera does not answer; else it refuses, or is not as it was asked to be.
        setting: what it is about, or empty.
        got: what came.
        expected: what would have been right.
    """

    gone: bool
    setting: str = ""
    got: str
    expected: str


class Answer(_Message):
    """Answer to a request.

    Attributes:
        number: of the request; 0 is the word that the camera is open, or why it cannot be.
        failure: why it was not done, or None.
        frame_numbers: of a camera that is set up: after this number of a frame comes 1.
        fault: why a frame is not whole, or empty.
        info: of a whole frame.
    """

    number: int
    failure: Failure | None = None
    frame_numbers: int = 0
    fault: str = ""
    info: FrameInfo | None = None
