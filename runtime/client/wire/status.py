"""The one place where errors become gRPC status codes, and on the client's side errors again."""

import re
from typing import Any

import grpc
from google.rpc import error_details_pb2 as rpc_details
from google.rpc import status_pb2 as rpc_status

from lightpage import errors
from lightpage.errors import ERRORS, CallerLeft, InvalidInputError, LightpageError, LostPageError, Reason
from lightpage.failures import understood
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import enum_name, member_of, message_of

DETAIL_KEY = "lightpage-error-bin"
STATUS_KEY = "grpc-status-details-bin"
DOMAIN = "lightpage"

_Code = grpc.StatusCode
_MEANINGS: tuple[tuple[type[BaseException], grpc.StatusCode, pb.ErrorReason], ...] = (
    (errors.MalformedError, _Code.INVALID_ARGUMENT, pb.ERROR_REASON_MALFORMED),
    (errors.RequestIdError, _Code.INVALID_ARGUMENT, pb.ERROR_REASON_REQUEST_ID),
    (errors.NoSuchPageError, _Code.INVALID_ARGUMENT, pb.ERROR_REASON_NO_SUCH_PAGE),
    (errors.BlackFrameError, _Code.INVALID_ARGUMENT, pb.ERROR_REASON_FRAME_BLACK),
    (errors.SaturatedFrameError, _Code.INVALID_ARGUMENT, pb.ERROR_REASON_FRAME_SATURATED),
    (errors.FramesDisagreeError, _Code.INVALID_ARGUMENT, pb.ERROR_REASON_FRAMES_DISAGREE),
    (errors.FrameError, _Code.INVALID_ARGUMENT, pb.ERROR_REASON_FRAME_FORMAT),
    (InvalidInputError, _Code.INVALID_ARGUMENT, pb.ERROR_REASON_INVALID_VALUE),
    (errors.LimitError, _Code.RESOURCE_EXHAUSTED, pb.ERROR_REASON_TOO_LARGE),
    (errors.LostShotError, _Code.DATA_LOSS, pb.ERROR_REASON_SHOT_LOST),
    (LostPageError, _Code.DATA_LOSS, pb.ERROR_REASON_PAGE_NOT_BELIEVED),
    (errors.LostDataError, _Code.DATA_LOSS, pb.ERROR_REASON_PAGE_NOT_BELIEVED),
    (errors.SlotsTakenError, _Code.RESOURCE_EXHAUSTED, pb.ERROR_REASON_OVERLOADED),
    (errors.OtherModelError, _Code.ABORTED, pb.ERROR_REASON_OTHER_MODEL),
    (errors.BusyError, _Code.ABORTED, pb.ERROR_REASON_RECALIBRATION_RUNS),
    (errors.NoSourceError, _Code.FAILED_PRECONDITION, pb.ERROR_REASON_NO_SOURCE),
    (errors.SourceError, _Code.FAILED_PRECONDITION, pb.ERROR_REASON_SOURCE_BROKEN),
    (errors.StorageError, _Code.UNAVAILABLE, pb.ERROR_REASON_STORAGE),
    (errors.SurroundingsError, _Code.RESOURCE_EXHAUSTED, pb.ERROR_REASON_SURROUNDINGS),
    (errors.StoppingError, _Code.UNAVAILABLE, pb.ERROR_REASON_STOPPING),
    (errors.WorkerError, _Code.ABORTED, pb.ERROR_REASON_WORKER),
    (errors.ModelExistsError, _Code.ALREADY_EXISTS, pb.ERROR_REASON_MODEL),
    (errors.NoSuchModelError, _Code.NOT_FOUND, pb.ERROR_REASON_MODEL),
    (errors.StoreError, _Code.FAILED_PRECONDITION, pb.ERROR_REASON_STORE),
    (errors.NoCodeError, _Code.FAILED_PRECONDITION, pb.ERROR_REASON_NO_CODE),
    (errors.ProviderError, _Code.FAILED_PRECONDITION, pb.ERROR_REASON_MODEL),
    (errors.BundleError, _Code.FAILED_PRECONDITION, pb.ERROR_REASON_MODEL),
    (errors.RecalibrationRefusedError, _Code.FAILED_PRECONDITION, pb.ERROR_REASON_RECALIBRATION_REFUSED),
    (errors.CalibrationError, _Code.FAILED_PRECONDITION, pb.ERROR_REASON_RECALIBRATION_REFUSED),
    (errors.NoSuchJobError, _Code.NOT_FOUND, pb.ERROR_REASON_NO_SUCH_JOB),
    (errors.JobCancelledError, _Code.CANCELLED, pb.ERROR_REASON_JOB_CANCELLED),
    (errors.NotAllowedError, _Code.PERMISSION_DENIED, pb.ERROR_REASON_NOT_ALLOWED),
    (errors.StalledError, _Code.CANCELLED, pb.ERROR_REASON_STALLED),
    (CallerLeft, _Code.CANCELLED, pb.ERROR_REASON_UNSPECIFIED),
    (grpc.RpcError, _Code.CANCELLED, pb.ERROR_REASON_UNSPECIFIED),  # while reading from a sender who has gone
)
"""Of each error class its status and its reason; the first that fits counts."""

_RETRY_S = {errors.StorageError: 2.0, errors.SurroundingsError: 5.0, errors.NoRoomError: 5.0}
"""When to try again what failed by what passes, seconds: a disk that hiccups, and memory that others give back."""

_UNSAID = {
    _Code.RESOURCE_EXHAUSTED: ("{}", "a smaller or a later request"),
    _Code.UNAVAILABLE: (
        "no connection ({})",
        "a running Lightpage service at this address, and certificates where it asks for them",
    ),
    _Code.UNIMPLEMENTED: ("no such call ({})", "a Lightpage service, of this version or a later one"),
    _Code.DEADLINE_EXCEEDED: ("no answer within the call's deadline", "one, or a longer deadline"),
}
"""What ended a call that no service of this project did, with what gRPC says of it, and what was wanted."""

_FIELD = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*")
"""The name of a field, as those have that are about one."""

_TOLD, _LOOKED_AT = 1000, 4000
"""Characters of each part of an error that a caller hears, and of which folders are cut out: a caller's own text may be
millions of them."""
_FOLDERS = re.compile(r"(?<![\w./])(?:/[^\s/:'\"]+)+/(?=[^\s/:'\"])")
"""The folders of an absolute path, up to its last name."""


def foreseen(error: BaseException) -> BaseException:
    """Our own error for one that a library or the system raised for want of a resource or of storage, else itself."""
    if isinstance(error, CallerLeft | grpc.RpcError) or not isinstance(error, Exception):
        return error
    return understood("service", error) or error


def status_of(error: BaseException) -> grpc.StatusCode:
    """The status code for an error; INTERNAL for what nobody foresaw."""
    return _meaning(error)[0]


def reason_of(error: BaseException) -> pb.ErrorReason:
    """The reason that goes with the status."""
    reason = _meaning(error)[1]
    if reason == pb.ERROR_REASON_OVERLOADED and isinstance(error, errors.OverloadedError) and error.retry_s is None:
        return pb.ERROR_REASON_DEADLINE_TOO_SHORT
    return reason


def reason_name(error: BaseException) -> str:
    """The reason's name without its prefix, as callers read it."""
    return enum_name(pb.ErrorReason.DESCRIPTOR, reason_of(error))


def _meaning(error: BaseException) -> tuple[grpc.StatusCode, pb.ErrorReason]:
    error = foreseen(error)
    for kind, code, reason in _MEANINGS:
        if isinstance(error, kind):
            return code, reason
    return grpc.StatusCode.INTERNAL, pb.ERROR_REASON_INTERNAL


def without_folders(text: str) -> str:
    """`text` with every absolute path in it cut to its last name: where the service keeps its files is its own."""
    return _FOLDERS.sub("", text)


def detail_of(error: LightpageError) -> pb.ErrorDetail:
    """A foreseen error as its message, files named without their folders."""
    parts = (error.subject, error.got, error.expected)
    subject, got, expected = (without_folders(text[:_LOOKED_AT])[:_TOLD] for text in parts)
    detail = pb.ErrorDetail(kind=type(error).__name__, thing=subject, got=got, wanted=expected)
    if isinstance(error, LostPageError):
        detail.MergeFrom(message_of(pb.ErrorDetail, reason=error.reason, recalibration_due=error.recalibration_due))
    return detail


def told(error: BaseException) -> str:
    """Return what a caller reads. An unforeseen error gives its class only: its text may hold anything."""
    error = foreseen(error)
    if isinstance(error, LightpageError):
        detail = detail_of(error)
        return f"{detail.thing}: got {detail.got}, wanted {detail.wanted}"[:2000]
    if isinstance(error, CallerLeft):
        return str(error)
    return f"{type(error).__name__} in the service; its log says more"


def trailers(error: BaseException) -> tuple[tuple[str, bytes], ...]:
    """The metadata that end a call beside its status: `ErrorDetail`, and google.rpc's details."""
    error = foreseen(error)
    code = status_of(error)
    info = rpc_details.ErrorInfo(reason=reason_name(error), domain=DOMAIN)
    details: list[Any] = [info]
    own: list[tuple[str, bytes]] = []
    if isinstance(error, LightpageError):
        detail = detail_of(error)
        own.append((DETAIL_KEY, detail.SerializeToString()))
        if isinstance(error, LostPageError):
            info.metadata["recalibration_due"] = "true" if error.recalibration_due else "false"
            info.metadata["loss_reason"] = error.reason.value
        elif isinstance(error, errors.OtherModelError):
            info.metadata["model_version"] = detail.got
        if (job := getattr(error, "job", None)) is not None:
            info.metadata["job"] = job
        if (retry_s := getattr(error, "retry_s", _RETRY_S.get(type(error)))) is not None:
            retry = rpc_details.RetryInfo()
            retry.retry_delay.FromNanoseconds(int(1e9 * retry_s))
            details.append(retry)
        if isinstance(error, InvalidInputError):
            field = detail.thing if _FIELD.fullmatch(detail.thing) else ""
            violation = rpc_details.BadRequest.FieldViolation(field=field, description=told(error))
            details.append(rpc_details.BadRequest(field_violations=[violation]))
    status = rpc_status.Status(code=code.value[0], message=told(error))
    for each in details:
        status.details.add().Pack(each)
    return (*own, (STATUS_KEY, status.SerializeToString()))


def refusal_of(error: BaseException) -> pb.Refusal:
    """Return how a call would have ended, for one page of many; an unforeseen error tells its class only."""
    error = foreseen(error)
    known = error if isinstance(error, LightpageError) else LightpageError("service", told(error), "an answer")
    return pb.Refusal(code=status_of(error).value[0], detail=detail_of(known), reason=reason_of(error))


def error_of(rpc: grpc.RpcError, target: str) -> LightpageError:
    """The error that the service at `target` meant, of the same class wherever it said which."""
    call: Any = rpc
    trailing = dict(call.trailing_metadata() or ())
    if DETAIL_KEY in trailing:
        info, retry, retry_s = rpc_details.ErrorInfo(), rpc_details.RetryInfo(), None
        for packed in rpc_status.Status.FromString(trailing.get(STATUS_KEY, b"")).details:
            packed.Unpack(info)
            if packed.Unpack(retry):
                retry_s = 1e-9 * retry.retry_delay.ToNanoseconds()
        error = error_from(pb.ErrorDetail.FromString(trailing[DETAIL_KEY]), retry_s)
        if isinstance(error, errors.BusyError):
            error.job = info.metadata.get("job")
        return error
    code, text = call.code(), call.details() or "no details"
    got, expected = _UNSAID.get(code, (f"{code.name}: {{}}", "an answer"))
    kind = errors.LimitError if code == _Code.RESOURCE_EXHAUSTED else LightpageError
    return kind(f"service at {target}", got.format(text), expected)


def is_lost_connection(rpc: grpc.RpcError) -> bool:
    """Return whether a call ended since the other end was gone, or early enough for another try, without an error."""
    call: Any = rpc
    if DETAIL_KEY in dict(call.trailing_metadata() or ()):
        return False
    return call.code() in (_Code.UNAVAILABLE, _Code.CANCELLED, _Code.UNKNOWN, _Code.DEADLINE_EXCEEDED)


def error_from(detail: pb.ErrorDetail, retry_s: float | None = None) -> LightpageError:
    """The error that a message stands for; `LightpageError` itself for a class that is not known here."""
    kind = ERRORS.get(detail.kind, LightpageError)
    parts = (detail.thing, detail.got, detail.wanted)
    if issubclass(kind, LostPageError):
        reason = member_of(Reason, pb.LossReason.DESCRIPTOR, detail.reason, Reason.UNSPECIFIED)
        return kind(*parts, reason, detail.recalibration_due)
    if issubclass(kind, errors.SlotsTakenError):
        return kind(*parts, retry_s)
    return kind(*parts)


def reason_told(error: BaseException | None) -> str:
    """The name of the reason that the caller hears; empty where there is none to tell."""
    if error is None or isinstance(error, CallerLeft) or not isinstance(error, Exception):
        return ""
    return reason_name(error)
