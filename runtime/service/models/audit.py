"""The record of every change of models: who did what, when, and how it ended. It outlives the service."""

import errno
import json
import logging
import os
import sqlite3
from collections.abc import Collection
from contextlib import closing, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from io import TextIOWrapper
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import cast

from lightpage.errors import StoreError
from lightpage.files import sync_folder, synchronise
from lightpage.runtime.service.caller import Actor
from lightpage.runtime.service.models.store import Store

AUDIT_BYTES = 10 << 20
"""Size of a record of model changes before a new one is begun: some 40,000 changes."""
AUDIT_KEPT = 10
"""Earlier records that stay."""
_NEWEST = 10_000
"""Entries that the database keeps: so many wait at most while the file cannot be written."""
_LAST_BYTES = 1 << 20
"""Length of the file's end in which a line is looked for that may have been appended."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """A change of models, done or failed.

    Attributes:
        what: one of `recalibrate`, `rollback`, `roll forward`, `activate`, `upload`, `pin`, `unpin`.
        actor: caller who changed the models.
        before: version in service before.
        after: version that the change is about; it is in service afterwards, except of an upload and a pin.
        failure: reason of a failed change.
        time: time of the change, in UTC by ISO 8601.
    """

    what: str
    actor: Actor
    before: str
    after: str
    failure: Exception | None = None
    time: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="milliseconds"))

    @property
    def line(self) -> str:
        """Entry as one line of JSON; unprintable characters are escaped."""
        who = {"who": self.actor.name, "correlation_id": self.actor.correlation_id}
        entry = {"time": self.time, "what": self.what, **who, "from": self.before, "to": self.after}
        how = {"outcome": "failed", "detail": self._detail} if self.failure else {"outcome": "done"}
        return json.dumps(entry | how, ensure_ascii=False).encode(errors="backslashreplace").decode()

    def log(self) -> None:
        """Write the entry to the service's log."""
        told = {"peer": self.actor.name, "correlation_id": self.actor.correlation_id, "method": self.what}
        change = f"from {self.before} to {self.after}" if self.after else f"of {self.before}"
        level, how = (logging.WARNING, f"failed: {self._detail}") if self.failure else (logging.INFO, "done")
        _log.log(level, "model change %s: %s, %s", self.what, change, how, extra={"told": told})

    @property
    def _detail(self) -> str:
        return str(self.failure) or repr(self.failure)


class AuditLog:
    """Keeps every change in the store's database, and appends it from there to a file as a line of JSON.

    A change is in the database with what it changes, or not at all. Its line is on the disk before `done` returns;
    one that cannot be appended waits, also for the next start. Nothing here fails for the sake of the file's disk. A
    file that has become too large is put aside as `NAME.1`, the one before it as `NAME.2`, and so on.

    Args:
        store: store with the database.
        path: file of the lines, None for none. Its folder is made if absent at the start, and not again later.
        most_bytes: largest size of the file.
        kept: number of files put aside that stay.
    """

    def __init__(
        self, store: Store, path: Path | None = None, most_bytes: int = AUDIT_BYTES, kept: int = AUDIT_KEPT
    ) -> None:
        self._store, self._path, self._most_bytes, self._kept = store, path, most_bytes, kept
        self._waiting: list[str] = []
        """Lines that wait for the database."""
        self._last = 0
        """Number of the entry that was appended last."""
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.open("ab").close()
            except OSError as error:
                _log.warning("model changes are not written down in %s: %s", path, error.strerror or error)
            self._export(_last_lines(path))

    def write(self, entry: Entry, database: sqlite3.Connection) -> None:
        """Write an entry, after those that wait, in a transaction; once that has ended, `done` is to be called."""
        lines = [(line,) for line in (*self._waiting, entry.line)]
        database.executemany("INSERT INTO audit (line) VALUES (?)", lines)
        database.execute("DELETE FROM audit WHERE number <= (SELECT max(number) FROM audit) - ?", (_NEWEST,))

    def done(self, entry: Entry) -> None:
        """Log an entry that is in the database, and append its line."""
        entry.log()
        self._waiting.clear()
        self._export()

    def failed(self, entry: Entry) -> None:
        """Record a failed change; queue the entry while the database cannot be written."""
        try:
            with self._store.transaction() as database:
                self.write(entry, database)
            self.done(entry)
        except StoreError:  # which the store has logged
            entry.log()
            self._waiting = [*self._waiting, entry.line][-_NEWEST:]

    def _export(self, known: Collection[str] = ()) -> None:
        """Append the lines that the file lacks; of those that are `known` to be there, only note that."""
        if self._path is None:
            return
        query = "SELECT number, line FROM audit WHERE NOT exported ORDER BY number"
        with suppress(StoreError), self._store.transaction() as database:
            for number, line in database.execute(query).fetchall():
                try:
                    if number > self._last and line not in known:
                        self._append(self._path, line.encode() + b"\n")
                except OSError as error:
                    _log.warning("model change not written down in %s: %s", self._path, error.strerror or error)
                    break
                self._last = max(self._last, number)
                database.execute("UPDATE audit SET exported = 1 WHERE number = ?", (number,))

    def _append(self, path: Path, line: bytes) -> None:
        """Append a line, whole or not at all, and have it on the disk.

        Raises:
            OSError: the file cannot be written.
        """
        with closing(RotatingFileHandler(path, maxBytes=self._most_bytes, backupCount=self._kept)) as file:
            as_long = logging.makeLogRecord({"msg": line.decode("latin-1")})  # it counts characters
            if file.shouldRollover(as_long):
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
    """Return the last lines of the file, and of the one before it."""
    lines = set[str]()
    for each in (path.with_name(f"{path.name}.1"), path):
        with suppress(OSError), each.open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - _LAST_BYTES))
            lines.update(file.read().decode(errors="replace").split("\n"))
    return lines
