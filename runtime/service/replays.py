"""At most one shot for a request id: whoever asks again gets the answer of the first time."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from lightpage.errors import InvalidInputError
from runtime.errors import RequestIdError, SlotsTakenError, StoppingError
from runtime.service.caller import Caller


@dataclass(eq=False)
class _Entry:
    """What is known of a request id; `request` tells whether it is the same request."""

    request: bytes
    done: bool = False
    answer: bytes = b""
    error: Exception | None = None
    ended_at: float = float("inf")

    def size(self, request_id: str) -> int:
        """Bytes that are kept of it: a request may be as long as a message, and an error has no answer."""
        return len(request_id) + len(self.request) + len(self.answer)


class Replays:
    """Remembers answers by request id, for a limited time and a limited number of bytes.

    Args:
        keep_s: how long, seconds.
        keep_bytes: how much of all answers, with their requests; the oldest go first.
        clock: seconds that never go back.
    """

    def __init__(self, keep_s: float, keep_bytes: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._keep_s, self._keep_bytes, self._clock = keep_s, keep_bytes, clock
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._entries: OrderedDict[str, _Entry] = OrderedDict()

    def once(self, request_id: str, request: bytes, caller: Caller, work: Callable[[], bytes]) -> tuple[bytes, bool]:
        """The answer to a request, made by `work` if there is none yet, and whether it was there already.

        An error is an answer too, unless nothing was done: the service was too busy, or the request wrong.

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
                until = time.monotonic() + caller.seconds_left()
                with self._changed:
                    self._changed.wait_for(
                        lambda: entry.done or not caller.is_here, min(until - time.monotonic(), threading.TIMEOUT_MAX)
                    )
            caller.check()
            if not entry.done:
                expected = "its answer; ask again with the same id"
                raise SlotsTakenError(f"request {request_id!r}", "no answer yet", expected, retry_s=1.0)
        if entry.error is not None:
            raise entry.error.with_traceback(None)  # else it grows with each answer
        return entry.answer, not mine

    def _work(self, request_id: str, entry: _Entry, work: Callable[[], bytes]) -> None:
        try:
            entry.answer = work()
        except Exception as error:
            entry.error = error
        except BaseException:
            self._drop(request_id, entry)
            raise
        finally:
            entry.ended_at = self._clock()
            if isinstance(entry.error, (SlotsTakenError, StoppingError, InvalidInputError)):
                self._drop(request_id, entry)
            entry.done = True
            self._tell()

    def _tell(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _drop(self, request_id: str, entry: _Entry) -> None:
        with self._lock:
            if self._entries.get(request_id) is entry:
                del self._entries[request_id]

    def _forget(self) -> None:
        """Drop answers that are too old, then the oldest where there are too many bytes of them."""
        now = self._clock()
        held = sum(entry.size(request_id) for request_id, entry in self._entries.items())
        for request_id, entry in list(self._entries.items()):
            if not entry.done:
                continue
            if now - entry.ended_at <= self._keep_s and held <= self._keep_bytes:
                break
            held -= entry.size(request_id)
            del self._entries[request_id]
