"""What a service remembers across restarts, in a folder with its bundles, and how the disk of the folder is."""

from __future__ import annotations

import errno
import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from pathlib import Path

from lightpage.errors import BundleError, LightpageError, StoreError
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import sha256
from lightpage.runtime.service.models.database import (
    DATABASE,
    Contents,
    Database,
    Statement,
    bundles_written,
    history_written,
)
from lightpage.runtime.service.models.earlier_store import EARLIER, read_earlier
from lightpage.runtime.service.models.folder import BundleFolder
from lightpage.runtime.service.models.history import History, State
from lightpage.runtime.service.models.store_health import Reason, StoreHealth, Trouble

_log = logging.getLogger(__name__)

KEPT_BUNDLES = 32
"""Bundles kept: a device that recalibrates itself for years shall not fill its disk, yet leave a trail to follow."""
PROBE_S = 30.0
"""Time after which it is tried again whether the store can be written, when somebody asks."""


class Store(AbstractContextManager["Store"]):
    """Bundles descended from one base bundle, and what is remembered of them; to be closed at the end.

    Without a folder nothing outlives the service. Methods may be called from many threads.

    Args:
        folder: one service at a time uses it; None for none.
        base: the bundle that the operator gave; another base has its own history.
        kept: how many of the newest bundles stay.
        clock: by which it is tried again now and then.

    Attributes:
        folder: of the bundles.
        kept: as above; without a folder none but those that are held.
        changing: held while models, jobs or the record of changes are changed: one change at a time.
        contents: of the database at the start.
        room_bytes: that a store which is well has for more.
        health: tells how it is without waiting for its disk.

    Raises:
        StoreError: the folder cannot be made, or another program uses it.
    """

    def __init__(
        self, folder: Path | None, base: Bundle, kept: int = KEPT_BUNDLES, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.changing, self.kept, self._clock = threading.RLock(), 0 if folder is None else kept, clock
        self.room_bytes, self.health = 0, StoreHealth(self.trouble)
        self._base = sha256(base.manifest.to_json())
        self._is_lost = self._is_closed = False
        """Whether there is no database that can be written: what is next to be remembered of models begins one."""
        self._damage: Trouble | None = None
        self._failure: Trouble | None = None
        self._probed = -float("inf")
        self.contents = Contents(self._base, State(History((base.version,))))
        self.folder = BundleFolder(folder)
        self._database = None if folder is None else Database(folder, self.folder.has_locks)
        try:
            self._resume()
        except BaseException:
            self.close()
            raise

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the folder, and wait for no disk; whoever changes something later hears that it is closed."""
        self._is_closed = True
        self.folder.close()

    def save(self, state: State, *more: Sequence[Statement], settles: bool = False) -> None:
        """Write the state of the models, and more with it, in one transaction.

        While something is lost that was in service, the history stays as it was until a state `settles` that.

        Raises:
            StoreError: it cannot be written; then all stays as it was.
        """
        with self.changing:
            if settles or self._damage is None or self._is_lost:
                more = (history_written(state.history, self._base), *more)
            self._write([bundles_written(state), *more], self._is_lost)
            self._is_lost = False
            if settles:
                self._damage = None

    def write(self, *parts: Sequence[Statement]) -> None:
        """Write, in one transaction, what is no state of the models.

        Raises:
            StoreError: it cannot be written; then all stays as it was.
        """
        with self.changing:
            if self._is_lost:
                raise StoreError(self.folder.subject, "no database", "one, which a change of models begins")
            self._write(parts)

    def _write(self, parts: Sequence[Sequence[Statement]], anew: bool = False) -> None:
        if self._database is None:
            return
        if self._is_closed:
            raise StoreError(self.folder.subject, "a store that is closed", "one in use")
        try:
            self.folder.check()
            self._database.write([statement for part in parts for statement in part], anew)
        except (OSError, sqlite3.Error) as error:
            raise self.failed(error) from None
        self._failure = None

    def _resume(self) -> None:
        """Read the database, or make one of what a store without one remembers."""
        if self._database is None:
            return
        try:
            self._is_lost = not self._database.exists
            found = self._without_database() if self._is_lost else self._database.read()
            history = found.state.history if found.base == self._base else self.contents.state.history
            self.contents = replace(found, state=replace(found.state, history=history))
            with suppress(StoreError, OSError):  # what cannot be written is logged, and the store's trouble
                if self._is_lost:
                    self.save(self.contents.state, found.jobs_written())
                for path in (self.folder.path / name for name in EARLIER):
                    path.rename(f"{path}.imported")
        except (sqlite3.Error, OSError) as error:
            raise StoreError(self.folder.subject, error, "one that no other program uses") from None
        except BundleError as error:
            self._is_lost = True
            self.damaged(Reason.NOTE, error)
            _log.warning("serving the base: %s", error)

    def _without_database(self) -> Contents:
        try:
            return read_earlier(self.folder.path, self.contents.state.history.current)
        except FileNotFoundError:
            if made := [version for version in self.folder.versions() if "+r" in version]:
                subject, expected = f"{self.folder.subject}: {DATABASE}", f"a database: there is {', '.join(made)}"
                raise BundleError(subject, "no such file", expected) from None
            return self.contents

    # ---- how it is -------------------------------------------------------------------------------------------------

    def damaged(self, reason: Reason, error: LightpageError) -> None:
        """Say that what was in service is lost; so it stays until a state that is saved settles it."""
        self._damage = Trouble(reason, str(error))

    @property
    def is_damaged(self) -> bool:
        """Whether it is not as it was left, and nobody has settled yet what is to be in service."""
        return self._damage is not None

    def check(self, needed_bytes: int = 0) -> None:
        """Try whether the store can be written and has room: `room_bytes`, or what is needed if that is more.

        Raises:
            StoreError: it cannot, or has not.
        """
        if self._database is None:
            return
        self._probed = self._clock()
        try:
            self.folder.probe(max(self.room_bytes, needed_bytes))
        except OSError as error:
            raise self.failed(error) from None
        self._failure = None

    def failed(self, error: OSError | sqlite3.Error) -> StoreError:
        """Remember that the store cannot be written; returns the error that says so."""
        if isinstance(error, sqlite3.Error):
            error = self._told_by_the_system(error)
        told = StoreError(self.folder.subject, error, "a folder that can be written and has room")
        if self._failure is None:
            _log.warning("%s", told)
        self._failure = Trouble(_REASONS.get(error.errno or 0, Reason.FAILED), str(told))
        return told

    def _told_by_the_system(self, error: sqlite3.Error) -> OSError:
        """Why the database cannot be written: the system says it, which SQLite keeps to itself."""
        try:
            self.folder.probe()
        except OSError as told:
            return told
        return OSError(_NUMBERS.get(getattr(error, "sqlite_errorcode", 0) & 0xFF, errno.EIO), str(error))

    def trouble(self) -> Trouble | None:
        """What is wrong with the store, None where nothing is; it is tried again where that was long ago."""
        if self._clock() - self._probed >= PROBE_S:
            with suppress(StoreError):
                self.check()
        return self.known_trouble()

    def known_trouble(self) -> Trouble | None:
        """What was wrong with the store when it was tried last; its disk is left alone."""
        return self._failure or self._damage


_NUMBERS = {
    sqlite3.SQLITE_FULL: errno.ENOSPC,
    sqlite3.SQLITE_READONLY: errno.EROFS,
    sqlite3.SQLITE_PERM: errno.EACCES,
    sqlite3.SQLITE_CANTOPEN: errno.ENOENT,
}
_REASONS = {
    **dict.fromkeys([errno.ENOSPC, errno.EDQUOT], Reason.FULL),
    **dict.fromkeys([errno.EROFS, errno.EACCES, errno.EPERM], Reason.READ_ONLY),
    **dict.fromkeys([errno.ENOENT, errno.ENOTDIR, errno.ESTALE, errno.ENODEV], Reason.GONE),
}
