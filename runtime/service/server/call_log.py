"""Logs how calls end."""

import logging
from collections.abc import Mapping
from typing import Any

import grpc

from lightpage.runtime.client.wire.status import reason_told, told

_FAULTS_OF_THE_SERVICE = frozenset(
    [grpc.StatusCode.FAILED_PRECONDITION, grpc.StatusCode.RESOURCE_EXHAUSTED, grpc.StatusCode.UNAVAILABLE]
)
"""Ends of calls that the operator of the service may want to do something about. Of lost pages `PageLog` tells."""

_log = logging.getLogger(__name__)


def log_end(
    about: Mapping[str, Any], code: grpc.StatusCode, error: BaseException | None, *, is_watch: bool = False
) -> None:
    """Log how a call has ended.

    Calls that end well, and watches that somebody ends, are told of at DEBUG. A traceback comes with errors that nobody
    foresaw, and with no other.

    Args:
        about: fields of the call, its name in ``method`` and its time in ``seconds`` among them.
        code: its status.
        error: None where it has ended well.
        is_watch: whether it lasts as long as its caller likes.
    """
    unforeseen = error if code is grpc.StatusCode.INTERNAL else None
    fields = {**about, "code": code.name, "reason": reason_told(error)}
    fields["seconds"] = fields.pop("seconds")  # behind what people look for first
    text = "done" if error is None else told(error) if isinstance(error, Exception) else "the caller has gone"
    level = _level(code, error, is_watch)
    _log.log(level, "%s: %s", about["method"], text, extra={"told": fields}, exc_info=unforeseen)


def _level(code: grpc.StatusCode, error: BaseException | None, is_watch: bool) -> int:
    if code is grpc.StatusCode.INTERNAL:
        return logging.ERROR
    if error is None or (is_watch and code is grpc.StatusCode.CANCELLED):
        return logging.DEBUG
    return logging.WARNING if code in _FAULTS_OF_THE_SERVICE else logging.INFO
