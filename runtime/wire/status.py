"""The one place where errors become gRPC status codes, and on the client's side errors again."""

from __future__ import annotations

import re
from typing import Any

import grpc

from lightpage.errors import (
    BundleError,
    BusyError,
    CalibrationError,
    InvalidInputError,
    LightpageError,
    LimitError,
    LostDataError,
    RecalibrationRefusedError,
)
from runtime.errors import (
    ERRORS,
    CallerLeft,
    LostPageError,
    Reason,
    SlotsTakenError,
    SourceError,
    StoppingError,
    WorkerError,
)
from runtime.pb.lightpage.v1 import lightpage_pb2 as pb

DETAIL_KEY = "lightpage-error-bin"

_CODES: tuple[tuple[type[BaseException], grpc.StatusCode], ...] = (
    (InvalidInputError, grpc.StatusCode.INVALID_ARGUMENT),
    (LimitError, grpc.StatusCode.RESOURCE_EXHAUSTED),
    (LostPageError, grpc.StatusCode.DATA_LOSS),
    (LostDataError, grpc.StatusCode.DATA_LOSS),
    (SlotsTakenError, grpc.StatusCode.RESOURCE_EXHAUSTED),
    (BusyError, grpc.StatusCode.ABORTED),
    (SourceError, grpc.StatusCode.FAILED_PRECONDITION),
    (StoppingError, grpc.StatusCode.UNAVAILABLE),
    (WorkerError, grpc.StatusCode.ABORTED),
    (BundleError, grpc.StatusCode.FAILED_PRECONDITION),
    (RecalibrationRefusedError, grpc.StatusCode.FAILED_PRECONDITION),
    (CalibrationError, grpc.StatusCode.FAILED_PRECONDITION),
    (CallerLeft, grpc.StatusCode.CANCELLED),
    (grpc.RpcError, grpc.StatusCode.CANCELLED),  # raised while reading a request whose sender has gone
)

_REASONS: dict[Reason, Any] = {reason: pb.LossReason.Value(f"LOSS_REASON_{reason}") for reason in Reason}

_FOLDERS = re.compile(r"(?<![\w./])(?:/[^\s/:'\"]+)+/(?=[^\s/:'\"])")
"""The folders of an absolute path, up to its last name."""


def status_of(error: BaseException) -> grpc.StatusCode:
    """The status code for an error; INTERNAL for what nobody foresaw."""
    for kind, code in _CODES:
        if isinstance(error, kind):
            return code
    return grpc.StatusCode.INTERNAL


def without_folders(text: str) -> str:
    """`text` with every absolute path in it cut to its last name: where the service keeps its files is its own."""
    return _FOLDERS.sub("", text)


def detail_of(error: LightpageError) -> pb.ErrorDetail:
    """A foreseen error as its message, files named without their folders."""
    subject, got, expected = (without_folders(text)[:1000] for text in (error.subject, error.got, error.expected))
    detail = pb.ErrorDetail(kind=type(error).__name__, thing=subject, got=got, wanted=expected)
    if isinstance(error, LostPageError):
        detail.reason = _REASONS[error.reason]
        detail.recalibration_due = error.recalibration_due
    return detail


def abort(context: grpc.ServicerContext, error: BaseException) -> None:
    """End the call with the status of `error`. Always raises, as `context.abort` does.

    A foreseen error names files without their folders. An unforeseen one gives its class only: its text may hold
    anything.
    """
    code = status_of(error)
    if isinstance(error, LightpageError):
        detail = detail_of(error)
        context.set_trailing_metadata(((DETAIL_KEY, detail.SerializeToString()),))
        context.abort(code, f"{detail.thing}: got {detail.got}, wanted {detail.wanted}"[:2000])
    context.abort(code, f"{type(error).__name__} in the service; its log says more")


def error_of(rpc: grpc.RpcError, target: str) -> LightpageError:
    """The error that the service at `target` meant, of the same class wherever it said which."""
    call: Any = rpc
    for key, value in call.trailing_metadata() or ():
        if key == DETAIL_KEY:
            detail = pb.ErrorDetail.FromString(value)
            kind, told = ERRORS.get(detail.kind, LightpageError), (detail.thing, detail.got, detail.wanted)
            if issubclass(kind, LostPageError):
                return kind(*told, _reason(detail.reason), detail.recalibration_due)
            return kind(*told)
    code, text = call.code(), call.details() or "no details"
    subject = f"service at {target}"
    if code == grpc.StatusCode.RESOURCE_EXHAUSTED:
        return LimitError(subject, text, "a smaller or a later request")
    if code == grpc.StatusCode.UNAVAILABLE:
        return LightpageError(subject, f"no connection ({text})", "a running Lightpage service at this address")
    return LightpageError(subject, f"{code.name}: {text}", "an answer")


def _reason(code: pb.LossReason) -> Reason:
    """A reason from the wire; one that this version does not know is unspecified."""
    return next((reason for reason, known in _REASONS.items() if known == code), Reason.UNSPECIFIED)
