"""What the service logs to stderr: lines for people or of JSON, of one kind only so many a second."""

from __future__ import annotations

import json
import logging
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal, TextIO

from lightpage.clock import SYSTEM, Clock
from lightpage.runtime.service.monitoring.observation import Observation

FIELDS = ("method", "peer", "correlation_id", "code", "reason", "seconds")
"""What may be said of a call beside the message, in this order."""

MOST_TEXT = 300
"""Characters of a text of a call in logs and traces: a caller chooses its correlation id."""
_WINDOW_S = 1.0
_MOST_KINDS = 1000
"""Kinds of lines that are counted apart; beyond them those of earlier seconds are forgotten."""
_log = logging.getLogger(__name__)


class PageLog:
    """Logs lost pages, an `Observer`: those of calls that go on too, which read many."""

    def observe(self, observation: Observation) -> None:
        """See `Observer`."""
        if observation.lost is not None:
            fields = {"method": "page", "reason": observation.lost.value, "seconds": round(observation.seconds, 4)}
            subject, detail = observation.subject, observation.detail
            text = detail if detail.startswith(subject) else f"{subject}: {detail}"
            _log.warning("lost with model %s: %s", observation.model_version, text, extra={"told": fields})


class TextFormatter(logging.Formatter):
    """A line for people: time, level, logger, message, and what else is said as KEY=VALUE."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as text; only a traceback has more than one line."""
        pairs = "".join(f" {key}={_word(value)}" for key, value in _fields(record).items())
        line = f"{_time(record)} {record.levelname} {record.name}: {_one_line(record.getMessage())}{pairs}"
        return f"{line}\n{self.formatException(record.exc_info)}" if _has_traceback(record) else line  # type: ignore[arg-type]


class JsonFormatter(logging.Formatter):
    """One JSON object a line, with the same in it, and a traceback as `traceback`."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as JSON."""
        entry = {
            "time": _time(record),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
            **_fields(record),
        }
        if _has_traceback(record):
            entry["traceback"] = self.formatException(record.exc_info)  # type: ignore[arg-type]
        return json.dumps(entry, default=str)


def _time(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")


def _has_traceback(record: logging.LogRecord) -> bool:
    told = record.exc_info  # False where a library has logged with `exc_info=False`
    return told is not None and bool(told) and told[0] is not None


def _fields(record: logging.LogRecord) -> dict[str, Any]:
    """What is said beside the message, without what is empty."""
    said = getattr(record, "told", {})
    known = [*(key for key in FIELDS if key in said), *(key for key in said if key not in FIELDS)]
    cut = {key: said[key][:MOST_TEXT] if isinstance(said[key], str) else said[key] for key in known}
    return {key: value for key, value in cut.items() if value != ""}


def _one_line(text: str) -> str:
    """Text of a caller must not look like a line of its own."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def _word(value: Any) -> str:
    text = str(value)
    return text if text.isprintable() and not set(text) & set(' "=') else json.dumps(text)


@dataclass
class _Second:
    """Lines of one kind in one second."""

    begun: float
    level: int
    logger: str
    shown: str
    lines: int = 0
    left_out: int = 0


class LimitedHandler(logging.StreamHandler[TextIO]):
    """Writes at most so many lines of one kind a second, and then one that says how many were left out.

    Of one kind are lines of one method and reason, and other lines that differ in their values only.

    Args:
        stream: where they go.
        lines_per_second: of one kind.
        clock: by which seconds pass.
    """

    def __init__(self, stream: TextIO | None, lines_per_second: int, clock: Clock = SYSTEM) -> None:
        super().__init__(stream)
        self._most, self._clock = lines_per_second, clock
        self._seconds: dict[tuple[str, ...], _Second] = {}
        self._ending = threading.Event()
        self._waker: threading.Thread | None = None
        """Tells of what was left out if nothing else is logged."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or count it; called with the handler's lock held."""
        kind, now = _kind(record), self._clock.now()
        second = self._seconds.get(kind)
        if second is None or now - second.begun >= _WINDOW_S:
            self._tell(kind, now)
            if len(self._seconds) >= _MOST_KINDS:
                self._forget(now)
            shown = " ".join(filter(None, kind)) if _is_of_a_call(record) else record.getMessage()
            second = self._seconds[kind] = _Second(now, record.levelno, record.name, shown)
        second.lines += 1
        if second.lines <= self._most:
            super().emit(record)
            return
        second.left_out += 1
        self._wake_later()

    def tell_left_out(self, at_once: bool = False) -> None:
        """Say what was left out in seconds that are over; `at_once`, in those that are not over too."""
        self.acquire()
        try:
            self._waker = None
            self._forget(self._clock.now(), at_once)
            if any(each.left_out for each in self._seconds.values()):
                self._wake_later()
        finally:
            self.release()

    def _wake_later(self) -> None:
        """See to it that what was left out is told of, even if nothing else is logged."""
        if self._waker is None:
            self._waker = threading.Thread(target=self._wait, name="lightpage-left-out", daemon=True)
            self._waker.start()

    def _wait(self) -> None:
        if not self._clock.wait(self._ending, _WINDOW_S):
            self.tell_left_out()

    def close(self) -> None:
        """Say what was left out, and end."""
        self._ending.set()
        self.tell_left_out(at_once=True)
        super().close()

    def _tell(self, kind: tuple[str, ...], now: float) -> None:
        second = self._seconds.get(kind)
        if second is None or not second.left_out:
            return
        text = f"{second.left_out} more of these were left out in {max(now - second.begun, _WINDOW_S):.0f} s"
        record = logging.LogRecord(second.logger, second.level, __file__, 0, "%s: %s", (second.shown, text), None)
        record.told = {"left_out": second.left_out}
        super().emit(record)
        second.left_out = 0

    def _forget(self, now: float, at_once: bool = False) -> None:
        """Say what was left out in seconds that are over, or `at_once` in all, and count anew."""
        for kind in [kind for kind, each in self._seconds.items() if at_once or now - each.begun >= _WINDOW_S]:
            self._tell(kind, now)
            del self._seconds[kind]


def _is_of_a_call(record: logging.LogRecord) -> bool:
    return "method" in getattr(record, "told", {})


def _kind(record: logging.LogRecord) -> tuple[str, ...]:
    said = getattr(record, "told", {})
    if _is_of_a_call(record):
        return str(said["method"]), str(said.get("reason") or said.get("code") or "")
    return record.name, str(record.msg)


def _thread_broke(found: threading.ExceptHookArgs) -> None:
    if found.exc_value is not None and not isinstance(found.exc_value, SystemExit):
        name = "of no name" if found.thread is None else found.thread.name
        _log.error("thread %s broke", name, exc_info=found.exc_value)


@contextmanager
def logging_to_stderr(
    form: Literal["text", "json"], level: str, lines_per_second: int, stream: TextIO | None = None
) -> Iterator[LimitedHandler]:
    """Have everything that is logged in the `with` statement written, and what ends threads that nobody waits for.

    Args:
        form: of a line.
        level: `debug`, `info`, `warning` or `error`; lesser lines are left out.
        lines_per_second: of one kind.
        stream: where to, stderr by default.
    """
    root = logging.getLogger()
    handler = LimitedHandler(sys.stderr if stream is None else stream, lines_per_second)
    handler.setFormatter(JsonFormatter() if form == "json" else TextFormatter())
    before, hook = root.level, threading.excepthook
    root.addHandler(handler)
    root.setLevel(level.upper())
    logging.captureWarnings(True)
    threading.excepthook = _thread_broke
    try:
        yield handler
    finally:
        threading.excepthook = hook
        logging.captureWarnings(False)
        root.setLevel(before)
        root.removeHandler(handler)
        handler.close()
