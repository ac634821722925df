"""The record of every change of models: who did what, when, and how it ended. It outlives the service."""

from __future__ import annotations

import errno
import json
import logging
import os
from collections import deque
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from io import TextIOWrapper
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import cast

from lightpage.files import sync_folder, synchronise
from lightpage.runtime.service.caller import Actor

AUDIT_BYTES = 10 << 20
"""Of a record of model changes before a new one is begun: some 40,000 changes."""
AUDIT_KEPT = 10
"""Earlier records that stay."""
_WAITING = 10_000
"""Lines that wait at most while the file cannot be written."""
_LAST_BYTES = 1 << 20
"""Of the file, in which a line is looked for that may have been appended."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """A change, or one that did not come about.

    Attributes:
        what: of `recalibrate`, `rollback`, `roll forward`, `activate`, `upload`, `pin`, `unpin`.
        actor: who.
        before: version in service before.
        after: version that the change is about; after all but an upload and a pin it is in service.
        failure: why it did not come about.
        time: in UTC, as ISO 8601 has it.
    """

    what: str
    actor: Actor
    before: str
    after: str
    failure: Exception | None = None
    time: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="milliseconds"))

    @property
    def line(self) -> str:
        """Itself in JSON."""
        who = {"who": self.actor.name, "correlation_id": self.actor.correlation_id}
        entry = {"time": self.time, "what": self.what, **who, "from": self.before, "to": self.after}
        how = {"outcome": "failed", "detail": self._detail} if self.failure else {"outcome": "done"}
        return json.dumps(entry | how)

    def log(self) -> None:
        """Log it."""
        told = {"peer": self.actor.name, "correlation_id": self.actor.correlation_id, "method": self.what}
        change = f"from {self.before} to {self.after}" if self.after else f"of {self.before}"
        level, how = (logging.WARNING, f"failed: {self._detail}") if self.failure else (logging.INFO, "done")
        _log.log(level, "model change %s: %s, %s", self.what, change, how, extra={"told": told})

    @property
    def _detail(self) -> str:
        return str(self.failure) or repr(self.failure)


class AuditLog:
    """Appends a line of JSON for each change to a file, and has it on the disk before `append` returns.

    Lines that cannot be written are logged, and wait. The database takes the lines that `pending` names together with
    the change itself, so that a program that is killed between the two writes the line at its next start. A file that
    has become too large is put aside as `NAME.1`, the one before it as `NAME.2`, and so on. One thread at a time may
    use it.

    Args:
        path: the file, None for none: then changes are logged alone. Its folder is made if absent; one that
            goes later, as that of a disk that is taken out, is not made again.
        most_bytes: of the file.
        kept: files put aside that stay.
    """

    def __init__(self, path: Path | None = None, most_bytes: int = AUDIT_BYTES, kept: int = AUDIT_KEPT) -> None:
        self._path, self._most_bytes, self._kept = path, most_bytes, kept
        self._waiting: deque[str] = deque(maxlen=_WAITING)
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.open("ab").close()
            except OSError as error:
                _log.warning("model changes are not written down in %s: %s", path, error.strerror or error)

    def resume(self, lines: Sequence[str]) -> None:
        """Append those of the lines that the service before was to write and has not."""
        written = set() if self._path is None else _last_lines(self._path)
        self._waiting.extend(line for line in lines if line not in written)
        self._write()

    def pending(self, entry: Entry) -> list[str]:
        """Return the lines that the file lacks until `append` has ended, that of the entry last."""
        return [] if self._path is None else [*self._waiting, entry.line]

    def append(self, entry: Entry) -> None:
        """Log an entry, and append its line after those that wait."""
        entry.log()
        self._waiting.append(entry.line)
        self._write()

    def _write(self) -> None:
        try:
            while self._waiting:
                if self._path is not None:
                    self._append(self._path, self._waiting[0].encode() + b"\n")
                self._waiting.popleft()
        except OSError as error:
            _log.warning("model change not written down in %s: %s", self._path, error.strerror or error)

    def _append(self, path: Path, line: bytes) -> None:
        """Append a line, whole or not at all, and have it on the disk.

        Raises:
            OSError: the file cannot be written.
        """
        with closing(RotatingFileHandler(path, maxBytes=self._most_bytes, backupCount=self._kept)) as file:
            if file.shouldRollover(logging.makeLogRecord({"msg": line.decode()})):
                file.doRollover()
            descriptor = cast(TextIOWrapper, file.stream).fileno()  # which a roll-over has opened again
            size = os.fstat(descriptor).st_size
            try:
                if os.write(descriptor, line) != len(line):
                    raise OSError(errno.ENOSPC, "a part of a line")
                synchronise(descriptor)
            except OSError:
                with suppress(OSError):
                    os.ftruncate(descriptor, size)
                raise
            if not size:
                sync_folder(path.parent)


def _last_lines(path: Path) -> set[str]:
    with suppress(OSError), path.open("rb") as file:
        file.seek(max(0, os.fstat(file.fileno()).st_size - _LAST_BYTES))
        return {*file.read().decode(errors="replace").splitlines()}
    return set()
