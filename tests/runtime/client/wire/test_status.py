"""Errors on the wire: each class has its status and its reason, and comes back as itself."""

import errno
from typing import Any

import grpc
import pytest
from google.rpc import error_details_pb2, status_pb2

from lightpage.errors import (
    ERRORS,
    BusyError,
    CallerLeft,
    InvalidInputError,
    LightpageError,
    LimitError,
    LostPageError,
    OverloadedError,
    Reason,
    SlotsTakenError,
    StorageError,
    SurroundingsError,
)
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.status import (
    DETAIL_KEY,
    STATUS_KEY,
    detail_of,
    error_from,
    error_of,
    foreseen,
    is_lost_connection,
    reason_name,
    refusal_of,
    status_of,
    told,
    trailers,
    without_folders,
)

MEANINGS = {
    "INVALID_ARGUMENT MALFORMED": ["MalformedError"],
    "INVALID_ARGUMENT REQUEST_ID": ["RequestIdError"],
    "INVALID_ARGUMENT NO_SUCH_PAGE": ["NoSuchPageError"],
    "INVALID_ARGUMENT FRAME_BLACK": ["BlackFrameError"],
    "INVALID_ARGUMENT FRAME_SATURATED": ["SaturatedFrameError"],
    "INVALID_ARGUMENT FRAMES_DISAGREE": ["FramesDisagreeError"],
    "INVALID_ARGUMENT FRAME_FORMAT": ["FrameError"],
    "INVALID_ARGUMENT INVALID_VALUE": ["InvalidInputError", "PageError", "ProfileError", "RecordingError"],
    "RESOURCE_EXHAUSTED TOO_LARGE": ["LimitError"],
    "RESOURCE_EXHAUSTED OVERLOADED": ["SlotsTakenError"],
    "RESOURCE_EXHAUSTED DEADLINE_TOO_SHORT": ["OverloadedError"],  # without a time after which to come again
    "RESOURCE_EXHAUSTED SURROUNDINGS": ["NoRoomError", "SurroundingsError"],
    "DATA_LOSS SHOT_LOST": ["LostShotError"],
    "DATA_LOSS PAGE_NOT_BELIEVED": ["LostDataError", "LostPageError", "UnconfirmedPageError"],
    "ABORTED OTHER_MODEL": ["OtherModelError"],
    "ABORTED RECALIBRATION_RUNS": ["BusyError", "TakenError"],
    "ABORTED WORKER": ["WorkerError"],
    "UNAVAILABLE STORAGE": ["StorageError"],
    "UNAVAILABLE STOPPING": ["StoppingError"],
    "ALREADY_EXISTS MODEL": ["ModelExistsError"],
    "NOT_FOUND MODEL": ["NoSuchModelError"],
    "NOT_FOUND NO_SUCH_JOB": ["NoSuchJobError"],
    "FAILED_PRECONDITION MODEL": ["BundleError", "ProviderError"],
    "FAILED_PRECONDITION STORE": ["StoreError"],
    "FAILED_PRECONDITION NO_CODE": ["NoCodeError"],
    "FAILED_PRECONDITION NO_SOURCE": ["NoSourceError"],
    "FAILED_PRECONDITION SOURCE_BROKEN": ["SourceError"],
    "FAILED_PRECONDITION RECALIBRATION_REFUSED": ["CalibrationError", "RecalibrationRefusedError"],
    "CANCELLED JOB_CANCELLED": ["JobCancelledError"],
    "CANCELLED STALLED": ["StalledError"],
    "PERMISSION_DENIED NOT_ALLOWED": ["NotAllowedError"],
    "INTERNAL INTERNAL": ["LightpageError", "MissingResultsError"],
}


class Ended(grpc.RpcError):
    """A call that ended as a server's calls do."""

    def __init__(self, code: grpc.StatusCode, text: str = "", trailing: Any = ()) -> None:
        self.code, self.details, self.trailing_metadata = lambda: code, lambda: text, lambda: trailing


def sent(error: BaseException) -> Ended:
    return Ended(status_of(error), told(error), trailers(error))


def details(error: BaseException, kind: Any) -> list[Any]:
    """google.rpc's details of a kind that an error is told with."""
    status = status_pb2.Status.FromString(dict(trailers(error))[STATUS_KEY])
    assert (status.code, status.message) == (status_of(error).value[0], told(error))
    found = []
    for packed in status.details:
        one = kind()
        if packed.Unpack(one):
            found.append(one)
    return found


def test_every_class_has_its_status_and_its_reason_and_comes_back_as_itself() -> None:
    found = dict[str, list[str]]()
    for name, kind in sorted(ERRORS.items()):
        more = (Reason.PILOTS_DISAGREE, True) if issubclass(kind, LostPageError) else ()
        error = kind("levels", "1", "2", *more)
        found.setdefault(f"{status_of(error).name} {reason_name(error)}", []).append(name)
        back = error_of(sent(error), "here")
        assert type(back) is kind
        assert (back.subject, back.got, back.expected) == ("levels", "1", "2")
        (info,) = details(error, error_details_pb2.ErrorInfo)
        assert (info.domain, info.reason) == ("lightpage", reason_name(error))
        assert pb.ErrorReason.Name(refusal_of(error).reason) == f"ERROR_REASON_{reason_name(error)}"
        violations = details(error, error_details_pb2.BadRequest)
        assert bool(violations) == isinstance(error, InvalidInputError)
        if violations:
            assert violations[0].field_violations[0].field == "levels"
    assert found == MEANINGS


def test_what_an_error_knows_beside_its_words_comes_along() -> None:
    for reason in Reason:
        lost = LostPageError("page 1", "noise", "light", reason, recalibration_due=reason is Reason.PILOTS_DISAGREE)
        back = error_of(sent(lost), "here")
        assert isinstance(back, LostPageError)
        assert (back.reason, back.recalibration_due) == (reason, lost.recalibration_due)
        (info,) = details(lost, error_details_pb2.ErrorInfo)
        assert info.metadata["recalibration_due"] == str(lost.recalibration_due).lower()
        assert info.metadata["loss_reason"] == reason.value
    busy = BusyError("recalibration", "one that runs", "none")
    busy.job = "job-1"
    assert error_of(sent(busy), "here").job == "job-1"  # type: ignore[attr-defined]
    for kind in (SlotsTakenError, OverloadedError):
        taken = error_of(sent(kind("slots", "all", "one", 1.5)), "here")
        assert type(taken) is kind
        assert taken.retry_s == 1.5
        assert reason_name(taken) == "OVERLOADED"


def test_a_class_that_this_version_does_not_know_is_the_base_of_all() -> None:
    detail = detail_of(OverloadedError("slots", "all", "one"))
    assert detail.kind == "OverloadedError"
    detail.kind = "NobodyKnowsError"
    assert type(error_from(detail)) is LightpageError


ALLOCATION = RuntimeError("[ONNXRuntimeError] : 6 : RUNTIME_EXCEPTION : Failed to allocate memory for requested buffer")


@pytest.mark.parametrize(
    ("error", "meaning", "retry_s"),
    [
        (StorageError("recording", "EIO", "data"), "UNAVAILABLE STORAGE", 2),
        (SurroundingsError("service", "ENOMEM", "memory"), "RESOURCE_EXHAUSTED SURROUNDINGS", 5),
        (OSError(errno.EIO, "x"), "UNAVAILABLE STORAGE", 2),
        (OSError(errno.EMFILE, "x"), "RESOURCE_EXHAUSTED SURROUNDINGS", 5),
        (MemoryError(), "RESOURCE_EXHAUSTED SURROUNDINGS", 5),
        (RuntimeError("can't start new thread"), "RESOURCE_EXHAUSTED SURROUNDINGS", 5),
        (ALLOCATION, "RESOURCE_EXHAUSTED SURROUNDINGS", 5),
        (ValueError("some bug"), "INTERNAL INTERNAL", None),
        (FileNotFoundError(errno.ENOENT, "x"), "INTERNAL INTERNAL", None),
        (CallerLeft(), "CANCELLED UNSPECIFIED", None),
        (Ended(grpc.StatusCode.UNKNOWN), "CANCELLED UNSPECIFIED", None),
    ],
)
def test_what_others_raise_has_its_status_and_when_to_try_again(
    error: BaseException, meaning: str, retry_s: float | None
) -> None:
    assert f"{status_of(error).name} {reason_name(error)}" == meaning
    assert refusal_of(error).code == status_of(error).value[0]
    delays = [one.retry_delay.ToSeconds() for one in details(error, error_details_pb2.RetryInfo)]
    assert delays == ([] if retry_s is None else [retry_s])
    assert isinstance(foreseen(error), LightpageError) == (retry_s is not None)


def test_an_unforeseen_error_tells_its_class_alone() -> None:
    error = ValueError("/srv/keys")
    assert told(error).startswith("ValueError")
    assert "keys" not in told(error) + str(refusal_of(error)) + str(trailers(error))
    assert DETAIL_KEY not in dict(trailers(error))


@pytest.mark.parametrize(
    "name", ["RESOURCE_EXHAUSTED", "UNAVAILABLE", "UNIMPLEMENTED", "DEADLINE_EXCEEDED", "INTERNAL"]
)
def test_what_the_library_says_by_itself_names_the_service(name: str) -> None:
    ended = Ended(grpc.StatusCode[name], "words of the library", None)
    error = error_of(ended, "device:50051")
    assert type(error) is (LimitError if name == "RESOURCE_EXHAUSTED" else LightpageError)
    assert error.subject == "service at device:50051"
    assert is_lost_connection(ended) == (name in ("UNAVAILABLE", "DEADLINE_EXCEEDED"))
    assert not is_lost_connection(sent(StorageError("disk", "EIO", "data")))  # it was meant


def test_errors_name_files_without_their_folders() -> None:
    for text, wanted in (
        ("recording /srv/data/R.h5: in_phase", "recording R.h5: in_phase"),
        ("recording:/srv/R.h5", "recording:R.h5"),
        ("unable to open file (name = '/srv/R.h5', errno = 2)", "unable to open file (name = 'R.h5', errno = 2)"),
        ("an AIR of 3.1 bit/symbol, uint8/uint16 / 2", "an AIR of 3.1 bit/symbol, uint8/uint16 / 2"),
    ):
        assert without_folders(text) == detail_of(LightpageError(text, 1, 2)).thing == wanted


def test_an_error_of_any_length_is_cut_before_it_is_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at: list[int] = []
    monkeypatch.setattr(
        "lightpage.runtime.client.wire.status.without_folders", lambda text: looked_at.append(len(text)) or text
    )
    error = LightpageError("a" * 5_000_000, "b" * 5_000_000, "c" * 5_000_000)
    detail = detail_of(error)
    assert (len(detail.thing), len(detail.got), len(detail.wanted)) == (1000, 1000, 1000)
    assert max(looked_at) <= 4000
    assert len(told(error)) == 2000
