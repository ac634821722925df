"""Tasks of workers and their answers: small values that name pages and never hold any."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from lightpage.codec.code import Code
from lightpage.errors import LightpageError
from lightpage.failures import may_pass
from lightpage.runtime.model.execution.providers import CPU


class Operation(StrEnum):
    """An operation on pages."""

    DECODE = "decode"
    RECOVER = "recover"
    EVALUATE = "evaluate"
    RECALIBRATE = "recalibrate"


class Plain(BaseModel):
    """A value of plain parts that never changes."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Problem(Plain):
    """An error in plain parts; see `lightpage.errors.LightpageError`.

    Attributes:
        passes: whether another try may go well a moment later, see `lightpage.failures.may_pass`.
    """

    subject: str
    got: str
    expected: str
    passes: bool = False

    @classmethod
    def of(cls, error: LightpageError) -> Problem:
        """Return the cause of an error."""
        return cls(subject=error.subject, got=error.got, expected=error.expected, passes=may_pass(error))

    def about(self, device: str) -> Problem:
        """Return the problem with the name of its device in a fleet; itself without a fleet."""
        return self.model_copy(update={"subject": f"device {device}: {self.subject}"}) if device else self

    def __str__(self) -> str:
        return f"{self.subject}: got {self.got}, wanted {self.expected}"


class Stamp(Plain):
    """A file's size in bytes and time of change in nanoseconds, by which it is known again."""

    size: int
    modified_ns: int

    @classmethod
    def of(cls, path: Path) -> Stamp:
        """Return the identity of a file.

        Raises:
            OSError: there is none.
        """
        found = path.stat()
        return cls(size=found.st_size, modified_ns=found.st_mtime_ns)


class NamedBundle(Plain):
    """A bundle, and how to know it again.

    Attributes:
        path: path of the bundle.
        sha256: hash by `bundle_sha256`; empty if it could not be read when the run began.
        version: version in its manifest; empty likewise.
        stamp: stamp of the file that was read; None if it could not be.
    """

    path: Path
    sha256: str
    version: str
    stamp: Stamp | None = None


class RecordedFile(Plain):
    """A recording, and how to know it again."""

    path: Path
    stamp: Stamp


class FineTuning(Plain):
    """Settings of fine-tuning a device's network, once its geometry is found.

    Attributes:
        steps: number of steps of the optimiser.
        learning_rate: peak of the learning rate.
        synthetic_pages: number of simulated pages beside the known ones.
        seed: seed of batches and rotations.
    """

    steps: int = 600
    learning_rate: float = 1e-3
    synthetic_pages: int = 0
    seed: int = 0


RANGE_PAGES = 32
"""Default number of pages of a range: few enough that a worker that dies costs little, and so many that the search for
the image on the first page does."""

KNOWN_PAGES = 2
"""Pages that a device is recalibrated with, unless told otherwise."""


class Choices(Plain):
    """Choices beside recordings and bundles.

    Attributes:
        operation: operation on each page or device.
        range_pages: pages of a range.
        tracking: whether the image is followed within a range.
        symbols: whether decoding keeps symbols and confidences.
        heals: whether the model is re-fitted by pages whose user bytes it does not read.
        code: code of the pages whose user bytes are read; None for each recording's, or else its bundle's.
        provider: provider that computes pages.
        batches: largest number of pages that are computed together.
        code_threads: number of threads that share the code of a page, where it is compiled.
        steps: largest number of Gauss-Newton steps of a page; None for as many as its bundle has.
        known_pages: number of pages that recalibrate a device; None for `KNOWN_PAGES`, or all with `fine_tuning`.
        fine_tuning: settings of training after the fit of the geometry; None to fit the geometry alone.
        parts: number of parts that processes do independently of each other.
    """

    operation: Operation
    range_pages: int = RANGE_PAGES
    tracking: bool = True
    symbols: bool = True
    heals: bool = True
    code: Code | None = None
    provider: str = CPU
    batches: int = 1
    code_threads: int = 1
    steps: int | None = None
    known_pages: int | None = None
    fine_tuning: FineTuning | None = None
    parts: int = 1

    @property
    def device_pages(self) -> int | None:
        """Known pages that a device is recalibrated with; None for all that it has."""
        return self.known_pages or (KNOWN_PAGES if self.fine_tuning is None else None)


class Task(Plain):
    """A range of pages of one recording, or one device to recalibrate.

    Attributes:
        choices: what is done, and how.
        device: its name in the fleet; empty without a fleet.
        files: the recording; of a device that is recalibrated all of its own, whose pages follow each other.
        pages: their numbers; to recalibrate, as many known pages as are wanted.
        bundle: what to decode with.
        shard: path of the result, without the end of its name.
        run: folder of the training run of a device that is recalibrated deeply.
        give_up: whether pages that storage does not give are lost, in place of the range having no result.
    """

    choices: Choices
    device: str = ""
    files: tuple[RecordedFile, ...]
    pages: tuple[int, ...]
    bundle: NamedBundle
    shard: Path
    run: Path | None = None
    give_up: bool = False

    @property
    def recalibrates(self) -> bool:
        """Return whether it is a device to recalibrate."""
        return self.choices.operation is Operation.RECALIBRATE

    @property
    def recording(self) -> Path:
        """Path of the recording, or of the first one."""
        return self.files[0].path

    @property
    def origin(self) -> tuple[str, Path]:
        """Device and recording."""
        return self.device, self.recording

    @property
    def weight(self) -> int:
        """Return the number of pages that the work counts as; a device that is recalibrated counts once."""
        return 1 if self.recalibrates else len(self.pages)

    @property
    def name(self) -> str:
        """Name the range, for people."""
        if self.recalibrates:
            more = len(self.files) - 1
            return f"recording {self.recording}" + (f" and {more} more" if more else "")
        return f"recording {self.recording}: pages {self.pages[0]}-{self.pages[-1]}"


class Step(Plain):
    """The present step of a worker on a device.

    Attributes:
        device: its name.
        what: for people.
    """

    device: str
    what: str


class Done(Plain):
    """A range whose result is written.

    Attributes:
        task: what was asked.
        lost: pages that are lost, by cause.
        left_out: pages that the bundle was made from.
        seconds: time that it took the worker.
        read_bytes: bytes read of frames, as they lie in the recording.
    """

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

    task: Task
    problem: Problem
    whole_recording: bool = False


Outcome = Done | Failed
