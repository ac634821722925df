"""Logging of the service to stderr: text or JSON lines, of one kind only so many a second."""

import json
import logging
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any, Literal, TextIO

from pydantic import Field

from lightpage.clock import SYSTEM, Clock
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.table import SettingsTable

MOST_TEXT = 300
"""Characters of a text of a call in logs and traces: a caller chooses its correlation id."""
_WINDOW_S = 1.0
_Shown = tuple[str, int, str]
"""Logger, level, and text of a kind of lines."""
_PLAIN = logging.Formatter()
_log = logging.getLogger(__name__)


class LogSettings(SettingsTable):
    """Format and level of logging to stderr: the table [logs] of the service's settings."""

    format: Literal["text", "json"] = "text"
    """Lines for people, or one object of JSON a line."""
    level: Literal["debug", "info", "warning", "error"] = "info"
    """Least level of a line; lesser lines are left out."""
    lines_per_second: int = Field(5, ge=1, le=100_000)
    """Lines of one kind in a second; the others are counted. Enough to see that it goes on, and too few to fill a disk
    in a night."""


class PageLog:
    """Logs lost pages, an `Observer`: also those of calls that continue after a lost page."""

    def observe(self, observation: Observation) -> None:
        """See `Observer`."""
        if observation.lost is not None:
            fields = {"method": "page", "reason": observation.lost.value, "seconds": round(observation.seconds, 4)}
            subject, detail = observation.subject, observation.detail
            text = detail if detail.startswith(subject) else f"{subject}: {detail}"
            _log.warning("lost with model %s: %s", observation.model_version, text, extra={"told": fields})


def _told(record: logging.LogRecord) -> dict[str, Any]:
    return getattr(record, "told", {})


def _one_line(text: str) -> str:
    """Text of a caller must not look like a line of its own."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def _word(text: str) -> str:
    return text if text.isprintable() and not set(text) & set(' "=') else json.dumps(text)


class LogHandler(logging.StreamHandler[TextIO]):
    """Writes a record and its `told`, what else is said of it, as a line: at most so many of one kind a second.

    Then a line says how many were left out. Lines are of one kind if method and reason agree, or else if only their
    values differ.

    Args:
        settings: format and number of the lines.
        stream: file that takes the lines.
        clock: clock that limits lines by the second.
    """

    def __init__(self, settings: LogSettings, stream: TextIO, clock: Clock = SYSTEM) -> None:
        super().__init__(stream)
        self._settings, self._clock, self._ending = settings, clock, threading.Event()
        self._begun, self._seen = clock.now(), dict[tuple[str, str], tuple[_Shown, int]]()
        """When this second began; and of each kind what is shown of it, and how many lines there were."""
        self._awaited = False
        """Whether a thread tells of what was left out if nothing else is logged."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line, of text or of JSON; behind one of text, a traceback has lines of its own."""
        cut = {key: value[:MOST_TEXT] if isinstance(value, str) else value for key, value in _told(record).items()}
        fields = {key: value for key, value in cut.items() if value != ""}
        # a library may have logged with `exc_info=False`, or outside of any `except`
        traceback = _PLAIN.formatException(record.exc_info) if record.exc_info and record.exc_info[0] else ""
        time, message = datetime.fromtimestamp(record.created, UTC), record.getMessage()
        head = {"time": time.isoformat(timespec="milliseconds"), "level": record.levelname, "logger": record.name}
        if self._settings.format == "json":
            last = {"traceback": traceback} if traceback else {}
            return json.dumps({**head, "message": message, **fields, **last}, default=str)
        pairs = "".join(f" {key}={_word(str(value))}" for key, value in fields.items())
        return f"{' '.join(head.values())}: {_one_line(message)}{pairs}" + f"\n{traceback}" * bool(traceback)

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or count it; called with the handler's lock held."""
        if self._clock.now() - self._begun >= _WINDOW_S:
            self._tell(self._begun)
        told, kind, text = _told(record), (record.name, str(record.msg)), record.getMessage()
        if "method" in told:
            kind = str(told["method"]), str(told.get("reason") or told.get("code") or "")
            text = " ".join(kind).rstrip()
        shown, count = self._seen.get(kind, ((record.name, record.levelno, text), 0))
        self._seen[kind] = shown, count + 1
        if count < self._settings.lines_per_second:
            super().emit(record)
        elif not self._awaited:
            self._awaited = True
            threading.Thread(target=self._wait, args=(self._begun,), name="lightpage-left-out", daemon=True).start()

    def _wait(self, begun: float) -> None:
        if not self._clock.wait(self._ending, begun + _WINDOW_S - self._clock.now()):
            self._tell(begun)

    def _tell(self, begun: float) -> None:
        """Say what was left out in the second that began then, unless another one has begun; and begin a new one."""
        with self.lock:  # type: ignore[union-attr]
            if begun != self._begun:
                return
            for (name, level, text), count in self._seen.values():
                if (more := count - self._settings.lines_per_second) > 0:
                    left = f"{more} more of these were left out in {max(self._clock.now() - begun, _WINDOW_S):.0f} s"
                    record = logging.LogRecord(name, level, __file__, 0, "%s: %s", (text, left), None)
                    record.told = {"left_out": more}
                    super().emit(record)
            self._begun, self._seen, self._awaited = self._clock.now(), {}, False

    def close(self) -> None:
        """Say what was left out, and end."""
        self._ending.set()
        self._tell(self._begun)
        super().close()


def _thread_broke(found: threading.ExceptHookArgs) -> None:
    if found.exc_value is not None and not isinstance(found.exc_value, SystemExit):
        name = "of no name" if found.thread is None else found.thread.name
        _log.error("thread %s broke", name, exc_info=found.exc_value)


@contextmanager
def logging_to_stderr(settings: LogSettings, stream: TextIO | None = None) -> Iterator[None]:
    """Have everything that is logged in the `with` statement written, and what ends threads that nobody waits for.

    Args:
        settings: what is written, and how.
        stream: where to, stderr by default.
    """
    root, hook, handler = logging.getLogger(), threading.excepthook, LogHandler(settings, stream or sys.stderr)
    before = root.level
    root.addHandler(handler)
    root.setLevel(settings.level.upper())
    logging.captureWarnings(True)
    threading.excepthook = _thread_broke
    try:
        yield
    finally:
        threading.excepthook = hook
        logging.captureWarnings(False)
        root.setLevel(before)
        root.removeHandler(handler)
        handler.close()
