"""Memory of a service across restarts: a folder with its bundles and a database, and the health of its disk."""

import errno
import logging
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from lightpage.errors import BundleError, LightpageError, StoreError
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.service.models.database import Contents, Database, Write, write_state
from lightpage.runtime.service.models.earlier_store import CURRENT, read_earlier
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
        clock: clock by which it is tried again now and then.

    Attributes:
        folder: folder of the bundles.
        kept: as above; without a folder none but those that are held.
        changing: held while models, jobs or the record of changes are changed: one change at a time.
        contents: contents of the database at the start.
        room_bytes: room that a store which is well has for more.
        health: tells how it is without waiting for its disk.

    Raises:
        StoreError: the folder cannot be made, or another program uses it.
    """

    def __init__(
        self, folder: Path | None, base: Bundle, kept: int = KEPT_BUNDLES, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.changing, self.kept, self._clock = threading.RLock(), 0 if folder is None else kept, clock
        self.room_bytes, self.health = 0, StoreHealth(self.trouble)
        self._base = base.digest
        self._is_begun = False
        """Whether there is a database to write to."""
        self._refused: tuple[str, str] | None = None
        """What came and what is wanted, for the error of whoever writes; None where that may be."""
        self._damage: Trouble | None = None
        self._failure: Trouble | None = None
        self._probed = -float("inf")
        self.contents = Contents(self._base, State(History((base.version,))))
        self.folder = BundleFolder(folder)
        self._database = Database(folder, self.folder.has_locks)
        try:
            self._resume()
            self.folder.sweep(self.contents.state.bundles, is_sure=self._is_begun)
        except BaseException:
            self.close()
            raise

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the folder, and wait for no disk; whoever changes something later hears that it is closed."""
        self._refused = "a store that is closed", "one in use"
        self.folder.close()

    def save(self, state: State, *more: Write, settles: bool = False) -> None:
        """Write the state of the models, and more with it, in one transaction.

        While something is lost that was in service, its history stays, or that it is lost, until a state `settles`
        that.

        Raises:
            StoreError: it cannot be written; then all stays as it was.
        """
        with self.changing:
            damage = None if settles else self._damage
            lost = "" if damage is None else self.contents.lost
            if damage is not None:
                state = replace(state, history=self.contents.state.history)
            with self.transaction(begins=True) as database:
                write_state(database, self._base, state, lost)
                for write in more:
                    write(database)
            self._damage = damage

    @contextmanager
    def transaction(self, begins: bool = False) -> Iterator[sqlite3.Connection]:
        """Yield the database, which holds all that is written to it at the end, or nothing of it.

        Args:
            begins: whether a new database may take the place of one that is damaged or gone.

        Raises:
            StoreError: it cannot be written; then all stays as it was.
        """
        with self.changing:
            refused = self._refused
            if self.contents.lost and not self._is_begun and not begins:
                refused = "no database", "one, which a change of models begins"
            if refused is not None:
                raise StoreError(self.folder.subject, *refused)
            try:
                self.folder.check()
                with self._database.transaction(None if self._is_begun else self.contents) as database:
                    yield database
            except (OSError, sqlite3.Error) as error:
                raise self.failed(error) from None
            self._is_begun, self._failure = True, None

    def _resume(self) -> None:
        """Go on with what is remembered; where there is no database, begin one with it."""
        try:
            found = self._found()
        except (OSError, sqlite3.Error) as error:
            if getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY:
                raise StoreError(self.folder.subject, error, "one that no other program uses") from None
            # What it remembers is not written over.
            self._refused = self.failed(error).got, "a database that can be read, at a start of the service"
            self._damage = self._failure
            return
        if found.base != self._base:
            served, base = found.state.history.current, self.contents.state.history.current
            _log.warning("%s: %s served, made from another base; %s begins anew", self.folder.subject, served, base)
            found = replace(found, state=replace(found.state, history=self.contents.state.history))
        self.contents = found
        if found.lost:
            self._damage = Trouble(Reason.NOTE, found.lost)
            _log.warning("serving the base: %s", found.lost)
        elif not self._is_begun:
            with suppress(StoreError), self.transaction():  # else it is logged, the store's trouble, and tried again
                pass

    def _found(self) -> Contents:
        """Return what is remembered.

        Raises:
            OSError, sqlite3.Error: it cannot be read.
        """
        if not self.folder.is_kept:
            return self.contents
        if self._database.exists:
            try:
                found = self._database.read()
            except BundleError as error:
                return replace(self.contents, lost=str(error))
            self._is_begun = True
            return found
        found = read_earlier(self.folder.path, self.contents)
        made = [version for version in self.folder.versions() if "+r" in version]
        if made and not found.lost and self.folder.path / CURRENT not in found.sources:
            expected = f"a database: there is {', '.join(made)}"
            return replace(found, lost=str(BundleError(str(self._database.path), "no such file", expected)))
        return found

    # ---- how it is -------------------------------------------------------------------------------------------------

    def damaged(self, reason: Reason, error: LightpageError) -> None:
        """Say that what was in service is lost; so it stays until a state that is saved settles it."""
        self._damage = Trouble(reason, str(error))

    @property
    def is_damaged(self) -> bool:
        """Return whether it is not as it was left, and nobody has settled yet what is to be in service."""
        return self._damage is not None

    def check(self, needed_bytes: int = 0) -> None:
        """Try whether the store can be written and has room: `room_bytes`, or what is needed if that is more.

        Raises:
            StoreError: it cannot, or has not.
        """
        if self._refused is not None:
            raise StoreError(self.folder.subject, *self._refused)
        if not self.folder.is_kept:
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
        """Return what is wrong with the store, None where nothing is; it is tried again where that was long ago."""
        if self._clock() - self._probed >= PROBE_S:
            with suppress(StoreError):
                self.check()
        return self.known_trouble()

    def known_trouble(self) -> Trouble | None:
        """Return what was wrong with the store when it was tried last; its disk is left alone."""
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
