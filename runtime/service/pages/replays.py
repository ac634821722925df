"""Replay of answers: one shot for a request id at most; a repeated request gets the first answer."""

import sys
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import InvalidInputError, RequestIdError, SlotsTakenError, StoppingError, StorageError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.status import error_from, refusal_of
from lightpage.runtime.service.caller import Caller

_NOTHING_DONE = (SlotsTakenError, StoppingError, InvalidInputError, StorageError)
"""Errors that come before a shot: the next call with the same id tries again."""

_OWN_BYTES = 500
"""An entry itself, and its place among the others."""


@dataclass(eq=False, slots=True)
class _Entry:
    """Answer of a request id: plain bytes alone, so that no frame of a page is kept.

    Attributes:
        request: tells whether it is the same request.
        done: whether the answer or the failure is there.
        answer: answer of a request that went well.
        failure: a serialised `ErrorDetail`; None where it went well.
        ended_at: when it was done, by the clock.
        size: bytes that are counted for it.
    """

    request: bytes
    done: bool = False
    answer: bytes = b""
    failure: bytes | None = None
    ended_at: float = float("inf")
    size: int = 0


class Replays:
    """Remembers answers by request id, for a limited time and a limited number of bytes.

    Args:
        keep_s: how long, seconds.
        keep_bytes: how much of all answers, with their requests; the oldest go first.
        clock: clock by which answers age and callers wait.
    """

    def __init__(self, keep_s: float, keep_bytes: int, clock: Clock = SYSTEM) -> None:
        self._keep_s, self._keep_bytes, self._clock = keep_s, keep_bytes, clock
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._entries: OrderedDict[str, _Entry] = OrderedDict()
        self._held = 0
        """Bytes of all entries that are done."""

    @property
    def held_bytes(self) -> int:
        """Return how much of all answers and failures is kept, with their requests."""
        with self._lock:
            return self._held

    def once(self, request_id: str, request: bytes, caller: Caller, work: Callable[[], bytes]) -> tuple[bytes, bool]:
        """The answer to a request, made by `work` if there is none yet, and whether it was there already.

        An error is an answer too, unless nothing was done: the service was too busy, its storage failed, or the request
        was wrong. The first caller gets the error that came, later ones an error of the same class and words.

        Args:
            request_id: the caller's, not empty.
            request: what was asked for; it must be the same each time.
            caller: waits while somebody else makes the answer.
            work: makes it; it is to go on when its caller leaves.

        Raises:
            RequestIdError: the id was given with another request.
            SlotsTakenError: the answer is not there yet when the caller's time is up.
            CallerLeft: the caller has gone.
        """
        with self._lock:
            self._forget()
            entry = self._entries.get(request_id)
            mine = entry is None
            if entry is None:
                entry = self._entries[request_id] = _Entry(request)
        if entry.request != request:
            raise RequestIdError(f"request id {request_id!r}", "another request", "the one that it was given with")
        if mine:
            self._work(request_id, entry, work)
        else:
            with caller.telling(self._tell):
                left_s = min(caller.seconds_left(), threading.TIMEOUT_MAX)
                with self._changed:
                    self._clock.wait_for(self._changed, lambda: entry.done or not caller.is_here, left_s)
            caller.check()
            if not entry.done:
                expected = "its answer; ask again with the same id"
                raise SlotsTakenError(f"request {request_id!r}", "no answer yet", expected, retry_s=1.0)
        if entry.failure is not None:
            raise error_from(pb.ErrorDetail.FromString(entry.failure))
        return entry.answer, not mine

    def _work(self, request_id: str, entry: _Entry, work: Callable[[], bytes]) -> None:
        kept = False
        try:
            entry.answer = work()
            kept = True
        except Exception as error:
            entry.failure = refusal_of(error).detail.SerializeToString()
            kept = not isinstance(error, _NOTHING_DONE)
            raise
        finally:
            with self._changed:
                entry.done, entry.ended_at = True, self._clock.now()
                if kept:
                    parts = (request_id, entry.request, entry.answer, entry.failure or b"")
                    entry.size = _OWN_BYTES + sum(map(sys.getsizeof, parts))
                    self._held += entry.size
                else:
                    del self._entries[request_id]
                self._changed.notify_all()

    def _tell(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _forget(self) -> None:
        """Drop answers that are too old, then the oldest where there are too many bytes of them."""
        now, gone = self._clock.now(), list[str]()
        for request_id, entry in self._entries.items():
            if not entry.done:
                continue
            if now - entry.ended_at <= self._keep_s and self._held <= self._keep_bytes:
                break
            self._held -= entry.size
            gone.append(request_id)
        for request_id in gone:
            del self._entries[request_id]
