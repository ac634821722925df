"""What a worker is asked to do, and what it answers: small values that name pages and never hold any."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from lightpage.errors import LightpageError


class Operation(StrEnum):
    """What is done with pages."""

    DECODE = "decode"
    RECOVER = "recover"
    EVALUATE = "evaluate"
    RECALIBRATE = "recalibrate"


class Plain(BaseModel):
    """A value of plain parts that never changes."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Problem(Plain):
    """An error in plain parts; see `lightpage.errors.LightpageError`."""

    subject: str
    got: str
    expected: str

    @classmethod
    def of(cls, error: LightpageError) -> Problem:
        """That of an error."""
        return cls(subject=error.subject, got=error.got, expected=error.expected)

    def about(self, device: str) -> Problem:
        """The same, and of which device of a fleet it is; itself without a fleet."""
        return self.model_copy(update={"subject": f"device {device}: {self.subject}"}) if device else self

    def __str__(self) -> str:
        return f"{self.subject}: got {self.got}, wanted {self.expected}"


class NamedBundle(Plain):
    """A bundle, and how to know it again.

    Attributes:
        path: where it lies.
        sha256: see `runtime.scaling.job.bundle_sha256`.
        version: of its manifest.
    """

    path: Path
    sha256: str
    version: str


class Stamp(Plain):
    """A file's size in bytes and time of change in nanoseconds, by which it is known again."""

    size: int
    modified_ns: int

    @classmethod
    def of(cls, path: Path) -> Stamp:
        """That of a file.

        Raises:
            OSError: there is none.
        """
        found = path.stat()
        return cls(size=found.st_size, modified_ns=found.st_mtime_ns)


class Task(Plain):
    """A range of pages of one recording, or one device to recalibrate.

    Attributes:
        operation: what to do.
        device: its name in the fleet; empty without a fleet.
        recording: path of the file.
        stamp: of the recording as it was when the run began.
        pages: their numbers; to recalibrate, as many known pages as are wanted.
        bundle: what to decode with.
        shard: path of the result, without the end of its name.
        tracking: whether the image is followed within the range.
        symbols: whether decoding keeps symbols and confidences.
    """

    operation: Operation
    device: str = ""
    recording: Path
    stamp: Stamp
    pages: tuple[int, ...]
    bundle: NamedBundle
    shard: Path
    tracking: bool = True
    symbols: bool = True

    @property
    def weight(self) -> int:
        """How many pages the work is worth in a count of all of it; a device that is recalibrated counts once."""
        return 1 if self.operation is Operation.RECALIBRATE else len(self.pages)

    @property
    def name(self) -> str:
        """Of the range, for people."""
        whole = self.operation is Operation.RECALIBRATE
        return f"recording {self.recording}" + ("" if whole else f": pages {self.pages[0]}-{self.pages[-1]}")


class Done(Plain):
    """A range whose result is written.

    Attributes:
        task: what was asked.
        lost: pages that are lost, by cause.
        left_out: pages that the bundle was made from.
        seconds: that it took the worker.
        read_bytes: of frames, as they lie in the recording.
    """

    kind: Literal["done"] = "done"
    task: Task
    lost: dict[str, int]
    left_out: int = 0
    seconds: float
    read_bytes: int = 0


class Failed(Plain):
    """A range without a result: nothing of it is written, and the next run tries again.

    Attributes:
        task: what was asked.
        problem: why.
        whole_recording: whether no page of the recording can be read, and not only this range.
    """

    kind: Literal["failed"] = "failed"
    task: Task
    problem: Problem
    whole_recording: bool = False


Outcome = Done | Failed
