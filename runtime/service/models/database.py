"""The SQLite file of what a service remembers across restarts: its models' history, its jobs, the record of changes."""

import os
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from lightpage.errors import BundleError
from lightpage.files import new_file, sync_folder
from lightpage.runtime.service.models.history import State, state_of

DATABASE = "models.db"
DAMAGED = "models.db.damaged"
"""Where a damaged database is kept once a new one is begun: somebody may read more in it."""

_IDENTITY = (0x4C504D44, 1)  # "LPMD"
"""Application and version of the database."""
_SCHEMA = (
    f"PRAGMA application_id = {_IDENTITY[0]}",
    f"PRAGMA user_version = {_IDENTITY[1]}",
    "CREATE TABLE models (base TEXT NOT NULL, state TEXT NOT NULL, lost TEXT NOT NULL)",
    "CREATE TABLE jobs (number INTEGER PRIMARY KEY, id TEXT UNIQUE NOT NULL, message BLOB NOT NULL)",
    "CREATE TABLE audit (number INTEGER PRIMARY KEY, line TEXT NOT NULL, exported INTEGER NOT NULL DEFAULT 0)",
)
_DAMAGE = {sqlite3.SQLITE_ERROR, sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}
"""Errors that say something of the content; all others say it of the disk, or of who else is there."""
_BUSY_S = 1.0
"""The transaction of another program is waited for so long; all changes wait with it."""

Write = Callable[[sqlite3.Connection], object]
"""Writes something in a transaction."""


@dataclass(frozen=True)
class Contents:
    """Contents of a database besides the record of changes.

    Attributes:
        base: digest of the base bundle that the history begins with.
        state: state of the models.
        jobs: messages of jobs by id, the oldest first.
        lost: why it is not known what was in service, empty where it is.
        sources: files of an earlier version that it was read from.
    """

    base: str
    state: State
    jobs: Mapping[str, bytes] = field(default_factory=dict)
    lost: str = ""
    sources: tuple[Path, ...] = ()


class Database:
    """A file that is opened for each transaction: nobody writes to one that was taken away or replaced.

    Args:
        folder: folder of the database; None for a database in memory.
        has_locks: whether other programs can be kept out by locks while it is written.

    Attributes:
        path: path of the database.
    """

    def __init__(self, folder: Path | None, has_locks: bool) -> None:
        self.path, self._options = (folder or Path()) / DATABASE, "" if has_locks else "&nolock=1"
        self._memory: sqlite3.Connection | None = None
        if folder is None:
            self._memory = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)

    @property
    def exists(self) -> bool:
        """Return whether there is a file, damaged or not; an empty one holds nothing."""
        return self._memory is None and self.path.exists() and self.path.stat().st_size > 0

    def read(self) -> Contents:
        """Return what it holds, checked; what a killed program has left of a transaction is undone.

        Raises:
            BundleError: it is damaged, or of another program.
            OSError, sqlite3.OperationalError: it cannot be read, or another program has locked it.
        """
        try:
            with closing(self._opened(self.path)) as database:
                identity = tuple(
                    database.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")
                )
                if identity != _IDENTITY:
                    raise ValueError(f"application and version {identity}")
                if (told := database.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
                    raise ValueError(told)
                database.execute("SELECT number, line, exported FROM audit LIMIT 0")
                ((base, state, lost),) = database.execute("SELECT base, state, lost FROM models")
                jobs = dict(database.execute("SELECT id, message FROM jobs ORDER BY number"))
                return Contents(base, state_of(state), jobs, lost)
        except (sqlite3.Error, ValueError) as error:
            if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF not in _DAMAGE:
                raise
            raise BundleError(f"database {self.path}", error, "one of this program's that is whole") from None

    @contextmanager
    def transaction(self, anew: Contents | None = None) -> Iterator[sqlite3.Connection]:
        """Yield the database; what is written is there at the end all or not at all, also after a kill or power cut.

        With `anew` a database is begun that holds this. It gets its name once it is whole; what had the name is put
        aside, and so are the files that the content was read from.

        Raises:
            OSError, sqlite3.Error: it cannot be written; then nothing has changed.
        """
        if self._memory is not None:
            with _within(self._memory, anew) as database:
                yield database
        elif anew is None:
            with closing(self._opened(self.path)) as database:
                with _within(database):
                    yield database
                if database.total_changes:
                    sync_folder(self.path.parent)  # the journal is gone: after a power cut it would undo all this
        else:
            descriptor, made = new_file(self.path.parent, DATABASE)
            os.close(descriptor)
            try:
                with closing(self._opened(made)) as database, _within(database, anew):
                    yield database
                self._put_aside()
                os.replace(made, self.path)
            finally:
                made.unlink(missing_ok=True)
            sync_folder(self.path.parent)
            for path in anew.sources:
                with suppress(OSError):  # nobody reads it while there is a database
                    path.rename(f"{path}.imported")

    def _opened(self, path: Path) -> sqlite3.Connection:
        uri = f"{path.absolute().as_uri()}?mode=rw{self._options}"
        database = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_BUSY_S)
        # With a rollback journal: a write-ahead log needs shared memory, which network shares lack. EXTRA would fail
        # after the end of a transaction where a folder cannot be synchronised.
        database.execute("PRAGMA synchronous = FULL")
        return database

    def _put_aside(self) -> None:
        """Move the file away with its journal, which would be played back into the next one."""
        for end in ("-journal", ""):
            with suppress(FileNotFoundError):
                os.replace(f"{self.path}{end}", self.path.with_name(DAMAGED + end))


@contextmanager
def _within(database: sqlite3.Connection, anew: Contents | None = None) -> Iterator[sqlite3.Connection]:
    """Yield the database in a transaction."""
    database.execute("BEGIN IMMEDIATE")
    try:
        if anew is not None:
            for definition in _SCHEMA:
                database.execute(definition)
            write_state(database, anew.base, anew.state, anew.lost)
            for id_, message in anew.jobs.items():
                write_job(database, id_, message, len(anew.jobs))
        yield database
        database.execute("COMMIT")
    except BaseException:
        database.rollback()
        raise


def write_state(database: sqlite3.Connection, base: str, state: State, lost: str) -> None:
    """Write what `Contents` calls so, in place of what was."""
    database.execute("DELETE FROM models")
    database.execute("INSERT INTO models VALUES (?, ?, ?)", (base, state.to_json(), lost))


def write_job(database: sqlite3.Connection, id_: str, message: bytes, kept: int) -> None:
    """Write a job, and forget all but the newest `kept`."""
    upsert = "INSERT INTO jobs (id, message) VALUES (?, ?) ON CONFLICT (id) DO UPDATE SET message = excluded.message"
    database.execute(upsert, (id_, message))
    database.execute("DELETE FROM jobs WHERE number <= (SELECT max(number) FROM jobs) - ?", (kept,))
