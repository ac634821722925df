"""What a GenTL camera and the process that has its producer say to each other: lines of JSON over a socket."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict

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
        memory_bytes: its size.
    """

    settings: CameraSettings
    frame_shape: tuple[int, int]
    memory: int
    memory_bytes: int


class Do(StrEnum):
    """What the process can be asked for."""

    ARM = "ARM"
    """Set it up, or set it up anew: answered by `Ready`."""
    FIRE = "FIRE"
    FRAME = "FRAME"
    """Answered by `Arrived`, or by nothing more where no frame came."""
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


class Ready(_Message):
    """A camera that is set up.

    Attributes:
        serial: of the camera, as the producer has it.
        exposure_s: as read back; None where the camera knows no exposure.
        frame_numbers: after this number of a frame comes 1.
    """

    serial: str
    exposure_s: float | None
    frame_numbers: int


class Arrived(_Message):
    """A frame; where it is whole it lies in the shared memory until the next request.

    Attributes:
        fault: why it is not whole, or empty.
        frame_id, device_time_s, host_time_s: see `FrameInfo`.
    """

    fault: str = ""
    frame_id: int = 0
    device_time_s: float = 0.0
    host_time_s: float = 0.0


class Answer(_Message):
    """Answer to a request; number 0 is the word that the camera is open, or why it cannot be."""

    number: int
    failure: Failure | None = None
    ready: Ready | None = None
    arrived: Arrived | None = None
