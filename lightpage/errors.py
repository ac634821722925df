"""The one error hierarchy: every error names its subject, what came and what was wanted."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from copyreg import __newobj__  # type: ignore[attr-defined]  # which typeshed leaves out
from enum import StrEnum
from json import JSONDecodeError
from tomllib import TOMLDecodeError
from traceback import clear_frames
from typing import Any, ClassVar, Self


class Cause(StrEnum):
    """Cause of a failure; `lightpage.failures.cause_of` finds that of any exception."""

    LIGHT = "light"
    """The light of a page: it was read as it is, and cannot be decoded. A finding, which stays."""
    CONTENT = "content"
    """The content of a recording, a bundle or a request: healthy storage would give the same again."""
    STORAGE = "storage"
    """The storage under a file, which gave nothing or damaged data: another try may go well."""
    SURROUNDINGS = "surroundings"
    """Things that the program needs to run: memory, threads, a worker, a provider."""


def lowered(text: str) -> str:
    """Return a text for the middle of a sentence, where its first word is no abbreviation."""
    return text[:1].lower() + text[1:] if text[1:2].islower() or text[1:2] == " " else text


_SYSTEM = {errno.EISDIR: "a folder", errno.ENOTDIR: "a file in place of a folder"}
_LIBRARIES = {
    "not a zip file": "no zip file",
    "signature not found": "no HDF5 file",
    "cannot identify image": "no picture",
    "cannot reshape": "data that end too early",
    "truncated": "data that end too early",
    "failed to read": "data that end too early",
}
"""Words of errors of libraries, and what has come then."""


def in_words(got: object) -> str:
    """Return what came; errors of the system and of libraries are sentences, and become nouns where they are known."""
    text = str(got)
    if isinstance(got, OSError) and got.strerror:
        return _SYSTEM.get(got.errno or 0) or lowered(got.strerror)
    if isinstance(got, JSONDecodeError | TOMLDecodeError):
        return f"text that is not {type(got).__name__[:4]} ({text})"
    if isinstance(got, Exception):
        return next((noun for words, noun in _LIBRARIES.items() if words in text.lower()), text)
    return text


class LightpageError(Exception):
    """Base of every error that Lightpage raises on purpose.

    Args:
        subject: thing that the error is about, e.g. ``"recording R.h5: dataset 'in_phase'"``.
        got: value or state that came; for an error of the system or of a library, see `in_words`.
        expected: value or state that would have been right.

    Attributes:
        cause: cause of the class's errors.
    """

    cause: ClassVar[Cause] = Cause.SURROUNDINGS

    def __init__(self, subject: str, got: object, expected: object) -> None:
        self.subject = subject
        self.got = in_words(got)
        self.expected = str(expected)
        super().__init__(f"{subject}: got {self.got}, wanted {self.expected}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Have it cross to another process with its class and all that it says."""
        return __newobj__, (type(self), *self.args), vars(self)


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


class NoRoomError(SurroundingsError):
    """A disk or a quota is full; once it has room, the same command may go well."""


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


class SourceError(LightpageError):
    """The service's own source or recordings are missing, damaged or dark: nothing that the caller sent is wrong."""


class NoSourceError(SourceError):
    """The service has no source, or none that can do this."""


class MalformedError(InvalidInputError):
    """A message that cannot be parsed, or one of a stream that does not belong there."""


class RequestIdError(InvalidInputError):
    """A request id that was given with another request."""


class StoppingError(LightpageError):
    """The service is being stopped and drops the work."""


class WorkerError(LightpageError):
    """A process that the service had started was killed, broke, or took too long; what it worked on is as before."""


class ProviderError(LightpageError):
    """The execution provider that was asked for is not here, or failed: nothing is wrong with the bundle."""


class NotAllowedError(LightpageError):
    """The caller's certificate does not allow this."""


class CallerLeft(Exception):
    """The caller has gone away; the work is dropped."""

    def __str__(self) -> str:
        return "the caller has gone"


class SlotsTakenError(BusyError):
    """The service does as much as it may at once, and did so until the caller's time was up.

    Args:
        subject: as of `LightpageError`.
        got: as of `LightpageError`.
        expected: as of `LightpageError`.
        retry_s: seconds after which to try again; None where that is of no use.
    """

    def __init__(self, subject: str, got: object, expected: object, retry_s: float | None = None) -> None:
        super().__init__(subject, got, expected)
        self.retry_s = retry_s


class OverloadedError(SlotsTakenError):
    """Refusal of work that could not be done before the caller's deadline, so that it is not begun."""


class StalledError(LightpageError):
    """The caller sent nothing for too long."""


class JobCancelledError(LightpageError):
    """Somebody cancelled the job; nothing was changed."""


class NoSuchJobError(LightpageError):
    """There is no such job, or it ended long ago."""


class OtherModelError(BusyError):
    """Another model is in service than the caller expected; nothing was changed. `got` is its version."""


class NoSuchModelError(BundleError):
    """The service has no such model, or none of this version."""


class ModelExistsError(BundleError):
    """The service has a model of this version already."""


class StoreError(BundleError):
    """The folder in which the service keeps its models is full, read-only, or gone; nothing was changed."""


class Reason(StrEnum):
    """Reason why a page is lost."""

    UNSPECIFIED = "UNSPECIFIED"
    PILOTS_DISAGREE = "PILOTS_DISAGREE"
    """The pilots contradict what was decoded; the image was found, or nobody looked for it."""
    IMAGE_NOT_FOUND = "IMAGE_NOT_FOUND"
    """The pilots contradict what was decoded, and a search did not find the image: it lies further off, or the frames
    are not this page's."""
    TOO_FEW_PILOTS = "TOO_FEW_PILOTS"
    """The pilots agree, but are too few, or too dim, to tell a page from chance."""
    MISSING_FRAME = "MISSING_FRAME"
    """A camera sent no frame after a trigger."""
    INCOMPLETE_FRAME = "INCOMPLETE_FRAME"
    """Parts of a frame were lost on the way from a camera."""
    SKIPPED_FRAME = "SKIPPED_FRAME"
    """A frame's number does not follow the last one: a frame, or a trigger, was missed or doubled."""
    STRAY_FRAME = "STRAY_FRAME"
    """A frame came that no trigger was waiting for."""
    OTHER_SHOT = "OTHER_SHOT"
    """A frame is not of this trigger, by its camera's clock."""
    NOT_SYNCHRONISED = "NOT_SYNCHRONISED"
    """The cameras' clocks do not agree with the trigger's for long enough to tell whose a frame is."""
    CAMERA_GONE = "CAMERA_GONE"
    """A camera does not answer any more."""
    TRIGGER_GONE = "TRIGGER_GONE"
    """The trigger does not answer any more."""
    TRIGGER_REFUSED = "TRIGGER_REFUSED"
    """The trigger answers with an error."""
    NOT_ON_DISPLAY = "NOT_ON_DISPLAY"
    """The page was not on display in time, or not until both frames were in."""
    BEAM_CONTROL_FAILED = "BEAM_CONTROL_FAILED"
    """A beam could not be blocked or let through."""


class LostPageError(LightpageError):
    """A page could not be read, and nothing that the caller sent need be wrong: write or read it again.

    Args:
        subject: as of `LightpageError`.
        got: as of `LightpageError`.
        expected: as of `LightpageError`.
        reason: why.
        recalibration_due: whether the device has changed since it was calibrated, as far as this page shows.
    """

    cause = Cause.LIGHT

    def __init__(
        self,
        subject: str,
        got: object,
        expected: object,
        reason: Reason = Reason.UNSPECIFIED,
        recalibration_due: bool = False,
    ) -> None:
        super().__init__(subject, got, expected)
        self.reason, self.recalibration_due = reason, recalibration_due

    def about(self, page: str) -> Self:
        """Return this error with the page that it is about."""
        return type(self)(f"{page}: {self.subject}", self.got, self.expected, self.reason, self.recalibration_due)


class LostShotError(LostPageError):
    """A page was not photographed as one whole pair of frames; what is wrong is in the device."""

    def __str__(self) -> str:
        told = super().__str__()
        return told if self.reason is Reason.UNSPECIFIED else f"{told} ({self.reason.value})"


class UnconfirmedPageError(LostPageError):
    """The pilots of a page do not bear out what the decoder claims of it: its symbols would be noise.

    Attributes:
        page: decoded page, for figures and never for an answer; None on the client's side. The runtime's
            `tracking.unconfirmed_page` says of which class it is.
    """

    page: object = None

    def of(self, page: object) -> Self:
        """Itself, with what was decoded."""
        self.page = page
        return self

    def about(self, page: str) -> Self:
        """See `LostPageError`."""
        return super().about(page).of(self.page)


def let_go(error: BaseException) -> None:
    """Drop what the frames hold that led to an error, and to those behind it: pairs of camera frames among it.

    Whoever keeps the error for a while then keeps its class and words alone.
    """
    seen: set[int] = set()
    waiting: list[BaseException | None] = [error]
    while waiting:
        one = waiting.pop()
        if one is not None and id(one) not in seen:
            seen.add(id(one))
            clear_frames(one.__traceback__)
            waiting += [one.__cause__, one.__context__]


ERRORS: dict[str, type[LightpageError]] = {
    name: kind for name, kind in dict(globals()).items() if isinstance(kind, type) and issubclass(kind, LightpageError)
}
"""Every error by its name, for one that another process has met."""


@contextmanager
def raised_as(kind: type[LightpageError], *caught: type[LightpageError], about: str = "") -> Iterator[None]:
    """Raise errors of the classes `caught` as a `kind`, with `about` before what they name."""
    try:
        yield
    except caught as error:
        raise kind(about + error.subject, error.got, error.expected) from error
