"""The SQLite file of what a service remembers across restarts: its models' history, its jobs, the record of changes."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lightpage.errors import BundleError
from lightpage.runtime.model.bundle.manifest import check_version
from lightpage.runtime.service.models.history import History, Known, Origin, State

DATABASE = "models.db"
DAMAGED = "models.db.damaged"
"""Where a damaged database is kept once a new one is begun: somebody may read more in it."""

_IDENTITY = (0x4C504D44, 1)  # "LPMD"
"""Application and version of the database."""
_SCHEMA = (
    f"PRAGMA application_id = {_IDENTITY[0]}",
    f"PRAGMA user_version = {_IDENTITY[1]}",
    "CREATE TABLE service (base TEXT NOT NULL, cursor INTEGER NOT NULL)",
    "CREATE TABLE history (place INTEGER PRIMARY KEY, version TEXT NOT NULL)",
    "CREATE TABLE bundles (version TEXT PRIMARY KEY, origin TEXT, key TEXT, pinned INTEGER NOT NULL)",
    "CREATE TABLE jobs (number INTEGER PRIMARY KEY, id TEXT UNIQUE NOT NULL, message BLOB NOT NULL)",
    "CREATE TABLE audit (line TEXT NOT NULL)",
)

Statement = tuple[str, Sequence[tuple[Any, ...]]]
"""SQL that changes the database, and the rows of values that it is run with."""


@dataclass(frozen=True)
class Contents:
    """What a database holds.

    Attributes:
        base: digest of the base bundle that the history begins with.
        state: of the models.
        jobs: messages of jobs by id, the oldest first.
        audit: lines that may not be in the record of model changes yet, the oldest first.
    """

    base: str
    state: State
    jobs: Mapping[str, bytes] = field(default_factory=dict)
    audit: Sequence[str] = ()

    def check(self) -> None:
        """See whether it makes sense.

        Raises:
            ValueError, BundleError: it contradicts itself, or names what is no version.
        """
        history = self.state.history
        if not 0 <= history.cursor < len(history.versions):
            raise ValueError(f"bundle {history.cursor} of {len(history.versions)} in service")
        for version in history.versions:
            check_version(version, "bundle in service")

    def jobs_written(self) -> list[Statement]:
        """Return what writes the jobs."""
        return [part for job in self.jobs.items() for part in job_written(*job, kept=len(self.jobs))]


class Database:
    """Is opened for each transaction, so that nobody writes to a file that was taken away or replaced.

    Args:
        folder: where it lies.
        has_locks: whether other programs can be kept out by locks while it is written.

    Attributes:
        path: of it.
    """

    def __init__(self, folder: Path, has_locks: bool) -> None:
        self.path, self._options = folder / DATABASE, "" if has_locks else "&nolock=1"

    @property
    def exists(self) -> bool:
        """Whether there is a file, damaged or not; an empty one is what a killed program leaves that was to make it."""
        return self.path.exists() and self.path.stat().st_size > 0

    def read(self) -> Contents:
        """Return what it holds, checked; what a killed program has left of a transaction is undone.

        Raises:
            BundleError: it is damaged, or of another program.
            sqlite3.OperationalError: another program has locked it.
        """
        subject, expected = f"database {self.path}", "one of this program's that is whole"
        try:
            with closing(self._opened("rw")) as database:

                def values(query: str) -> list[Any]:
                    return [row[0] for row in database.execute(query)]

                identity = (*values("PRAGMA application_id"), *values("PRAGMA user_version"))
                if identity != _IDENTITY or (told := values("PRAGMA quick_check(1)")) != ["ok"]:
                    raise ValueError(told[0] if identity == _IDENTITY else f"application and version {identity}")
                ((base, cursor),) = database.execute("SELECT base, cursor FROM service")
                history = History(tuple(values("SELECT version FROM history ORDER BY place")), cursor)
                bundles = {
                    version: Known(None if origin is None else Origin(origin), key, bool(pinned))
                    for version, origin, key, pinned in database.execute("SELECT * FROM bundles")
                }
                jobs = dict(database.execute("SELECT id, message FROM jobs ORDER BY number"))
                contents = Contents(base, State(history, bundles), jobs, values("SELECT line FROM audit"))
                contents.check()
        except (sqlite3.Error, ValueError, TypeError, BundleError) as error:
            if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_BUSY:
                raise
            raise BundleError(subject, error, expected) from None
        return contents

    def write(self, statements: Sequence[Statement], anew: bool = False) -> None:
        """Run statements in one transaction: all or none, also where the program is killed or the power cut.

        With `anew` an empty database is begun, and the one before put aside.

        Raises:
            OSError, sqlite3.Error: it cannot be written.
        """
        if anew and self.exists:
            self._put_aside()
        with closing(self._opened("rwc" if anew else "rw")) as database:
            database.execute("BEGIN IMMEDIATE")
            for definition in _SCHEMA if anew else ():
                database.execute(definition)
            for sql, rows in statements:
                database.executemany(sql, rows)
            database.execute("COMMIT")

    def _opened(self, mode: str) -> sqlite3.Connection:
        uri = f"{self.path.absolute().as_uri()}?mode={mode}{self._options}"
        database = sqlite3.connect(uri, uri=True, isolation_level=None)
        # With a rollback journal: a write-ahead log needs shared memory, which network shares lack. Only EXTRA
        # has the end of a transaction on the disk.
        database.execute("PRAGMA synchronous = EXTRA")
        return database

    def _put_aside(self) -> None:
        """Move the file away with its journal, which would be played back into the next one."""
        for end in ("-journal", ""):
            with suppress(FileNotFoundError):
                os.replace(f"{self.path}{end}", self.path.with_name(DAMAGED + end))


def history_written(history: History, base: str) -> list[Statement]:
    """Return what writes a history that begins with the base bundle of this digest."""
    return [
        *_table("service", "?, ?", [(base, history.cursor)]),
        *_table("history", "?, ?", enumerate(history.versions)),
    ]


def bundles_written(state: State) -> list[Statement]:
    """Return what writes all that is known of bundles."""
    rows = [(version, known.origin, known.key, known.pinned) for version, known in state.bundles.items()]
    return _table("bundles", "?, ?, ?, ?", rows)


def job_written(id_: str, message: bytes, kept: int) -> list[Statement]:
    """Return what writes a job, and forgets all but the newest `kept`."""
    upsert = "INSERT INTO jobs (id, message) VALUES (?, ?) ON CONFLICT (id) DO UPDATE SET message = excluded.message"
    forget = "DELETE FROM jobs WHERE number <= (SELECT max(number) FROM jobs) - ?"
    return [(upsert, [(id_, message)]), (forget, [(kept,)])]


def audit_written(lines: Sequence[str]) -> list[Statement]:
    """Return what writes the lines that are not in the record of model changes yet, in place of those before."""
    return _table("audit", "?", [(line,) for line in lines])


def _table(name: str, values: str, rows: Iterable[tuple[Any, ...]]) -> list[Statement]:
    return [(f"DELETE FROM {name}", [()]), (f"INSERT INTO {name} VALUES ({values})", list(rows))]
