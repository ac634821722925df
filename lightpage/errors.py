"""The one error hierarchy: every error names its subject, what came and what was wanted."""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar


class Cause(StrEnum):
    """What a failure is about; `lightpage.failures.cause_of` says it of any failure."""

    LIGHT = "light"
    """The light of a page: it was read as it is, and cannot be decoded. A finding, which stays."""
    CONTENT = "content"
    """The content of a recording, a bundle or a request: healthy storage would give the same again."""
    STORAGE = "storage"
    """The storage under a file, which gave nothing or damaged data: another try may go well."""
    SURROUNDINGS = "surroundings"
    """What the program needs to run: memory, threads, a worker, a provider."""


class LightpageError(Exception):
    """Base of every error that Lightpage raises on purpose.

    Args:
        subject: what the error is about, e.g. ``"recording R.h5: dataset 'in_phase'"``.
        got: what came; of an error of the operating system, what it says without number and path.
        expected: what would have been right.

    Attributes:
        cause: what errors of the class are about.
    """

    cause: ClassVar[Cause] = Cause.SURROUNDINGS

    def __init__(self, subject: str, got: object, expected: object) -> None:
        self.subject = subject
        self.got = (isinstance(got, OSError) and got.strerror) or str(got)
        self.expected = str(expected)
        super().__init__(f"{subject}: got {self.got}, wanted {self.expected}")


class InvalidInputError(LightpageError):
    """The caller's data are wrong: fix the input and call again."""

    cause = Cause.CONTENT


class ProfileError(InvalidInputError):
    """A device profile or device state that is malformed or unphysical."""


class RecordingError(InvalidInputError):
    """A recording that is truncated, foreign or inconsistent."""


class StorageError(LightpageError):
    """The storage under a file gave nothing, or damaged data, which says nothing of the file: try again."""

    cause = Cause.STORAGE


class SurroundingsError(LightpageError):
    """The program lacks what it needs to run, e.g. memory: nothing that it was given is wrong."""


class FrameError(InvalidInputError):
    """A camera frame of the wrong size, type or bit depth, or without usable light."""

    cause = Cause.LIGHT


class BlackFrameError(FrameError):
    """A frame without light."""


class SaturatedFrameError(FrameError):
    """A frame of which too much is at full scale."""


class FramesDisagreeError(FrameError):
    """Two frames that contradict each other: swapped, of two shots, or of a device that is not as it was calibrated."""


class PageError(InvalidInputError):
    """Symbols of the wrong shape, type or range."""


class NoSuchPageError(PageError):
    """The number of a page that is not there."""


class LostDataError(LightpageError):
    """Bytes of a file could not be read back from its pages, nor restored from its parity pages."""

    cause = Cause.LIGHT


class BundleError(LightpageError):
    """A bundle that is damaged, incomplete, foreign, or newer than this program."""

    cause = Cause.CONTENT


class NoCodeError(BundleError):
    """User bytes are wanted, and the bundle does not say how they are protected."""


class CalibrationError(LightpageError):
    """The known pages do not fit any geometry within the capture range."""

    cause = Cause.LIGHT


class RecalibrationRefusedError(LightpageError):
    """The re-fitted geometry would decode worse than the one in use; nothing was changed."""

    cause = Cause.LIGHT


class BusyError(LightpageError):
    """The resource is taken by another call; try again later.

    Attributes:
        job: id of the recalibration that has taken it, where it is one.
    """

    job: str | None = None


class TakenError(BusyError):
    """Another process has the resource; once that has ended, the same command may go well."""


class MissingResultsError(LightpageError):
    """Some of the work has no result; the same command tries that again, and repeats nothing else."""


class LimitError(LightpageError):
    """A request is larger than the service accepts."""

    cause = Cause.CONTENT
