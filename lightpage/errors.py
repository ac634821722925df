"""The one error hierarchy: every error names its subject, what came and what was wanted."""

from __future__ import annotations


class LightpageError(Exception):
    """Base of every error that Lightpage raises on purpose.

    Args:
        subject: what the error is about, e.g. ``"recording R.h5: dataset 'in_phase'"``.
        got: what came; of an error of the operating system, what it says without number and path.
        expected: what would have been right.
    """

    def __init__(self, subject: str, got: object, expected: object) -> None:
        self.subject = subject
        self.got = (isinstance(got, OSError) and got.strerror) or str(got)
        self.expected = str(expected)
        super().__init__(f"{subject}: got {self.got}, wanted {self.expected}")


class InvalidInputError(LightpageError):
    """The caller's data are wrong: fix the input and call again."""


class ProfileError(InvalidInputError):
    """A device profile or device state that is malformed or unphysical."""


class RecordingError(InvalidInputError):
    """A recording that is truncated, foreign or inconsistent."""


class UnreadableError(RecordingError):
    """Data of a recording that the file system did not give, or gave damaged: another try may go well."""


class FrameError(InvalidInputError):
    """A camera frame of the wrong size, type or bit depth, or without usable light."""


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


class BundleError(LightpageError):
    """A bundle that is damaged, incomplete, foreign, or newer than this program."""


class NoCodeError(BundleError):
    """User bytes are wanted, and the bundle does not say how they are protected."""


class CalibrationError(LightpageError):
    """The known pages do not fit any geometry within the capture range."""


class RecalibrationRefusedError(LightpageError):
    """The re-fitted geometry would decode worse than the one in use; nothing was changed."""


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
