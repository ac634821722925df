"""Logs how calls end."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import grpc

from lightpage.errors import CallerLeft
from lightpage.runtime.client.wire.status import reason_name, told

if TYPE_CHECKING:
    from lightpage.runtime.service.server.call import Call

_FAULTS_OF_THE_SERVICE = frozenset(
    [
        grpc.StatusCode.FAILED_PRECONDITION,
        grpc.StatusCode.RESOURCE_EXHAUSTED,
        grpc.StatusCode.UNAVAILABLE,
    ]
)
"""Ends of calls that the operator of the service may want to do something about. Of lost pages `PageLog` tells."""

_log = logging.getLogger(__name__)


class CallLog:
    """Logs how calls end.

    Calls that end well, and watches that somebody ends, are told of at DEBUG. A traceback comes with errors that nobody
    foresaw, and with no other.

    Args:
        clock: seconds, that of `Call.begun`.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock

    def ended(self, call: Call, code: grpc.StatusCode, error: BaseException | None) -> None:
        """A call has ended, well where `error` is None."""
        unforeseen = error if code is grpc.StatusCode.INTERNAL else None
        fields: dict[str, Any] = {
            "method": call.method,
            "peer": call.actor.name,
            "correlation_id": call.correlation_id,
            "code": code.name,
            "reason": reason_told(error),
            "seconds": round(self._clock() - call.begun, 4),
        }
        text = "done" if error is None else told(error) if isinstance(error, Exception) else "the caller has gone"
        _log.log(_level(call, code, error), "%s: %s", call.method, text, extra={"told": fields}, exc_info=unforeseen)


def _level(call: Call, code: grpc.StatusCode, error: BaseException | None) -> int:
    if code is grpc.StatusCode.INTERNAL:
        return logging.ERROR
    if error is None or (call.is_watch and code is grpc.StatusCode.CANCELLED):
        return logging.DEBUG
    return logging.WARNING if code in _FAULTS_OF_THE_SERVICE else logging.INFO


def reason_told(error: BaseException | None) -> str:
    """The name of the reason that the caller hears; empty where there is none to tell."""
    if error is None or isinstance(error, CallerLeft) or not isinstance(error, Exception):
        return ""
    return reason_name(error)
