"""The folder in which a service keeps its bundles, and remembers across restarts which of them it used."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import shutil
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from lightpage.errors import BundleError, LightpageError, StoreError
from lightpage.files import new_file, replace_text, synchronise
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import sha256
from lightpage.runtime.model.bundle.signature_file import signature_path

_log = logging.getLogger(__name__)

CURRENT = "current.json"

DAMAGED = "current.damaged.json"
"""Where a note that cannot be read is kept when a change writes a new one: somebody may read more in it."""

LOCK = ".lock"

UPLOAD = ".upload-"
"""How the name of an unfinished upload begins."""

PROBE = ".probe-"
"""How the name of a file begins that tries whether the store can be written."""

_LEFTOVERS = (f"{UPLOAD}*", f"{PROBE}*", f".{CURRENT}-*", ".*.zip-*")
"""Names of what a program that was killed leaves here."""

KEPT_BUNDLES = 32
"""Bundles kept: a device that recalibrates itself for years shall not fill its disk, yet leave a trail to follow."""

PROBE_S = 30.0
"""Time after which it is tried again whether the store can be written, when somebody asks."""


class Origin(StrEnum):
    """Where a bundle came from."""

    GIVEN = "given"
    RECALIBRATED = "recalibrated"
    UPLOADED = "uploaded"


class Reason(StrEnum):
    """What is wrong with a store."""

    NOTE = "note"
    """Its note is damaged or gone, so that it is not known what was in service."""
    BUNDLE = "bundle"
    """The bundle that was in service is damaged or gone."""
    FULL = "full"
    READ_ONLY = "read_only"
    GONE = "gone"
    HUNG = "hung"
    """The disk does not answer."""
    FAILED = "failed"
    """The disk fails in another way."""


@dataclass(frozen=True)
class Trouble:
    """What is wrong with a store, and the same for people."""

    reason: Reason
    text: str


@dataclass(frozen=True)
class Note:
    """What a store remembers.

    Attributes:
        history: names of bundles in the order in which they came into service, None for the base.
        cursor: index of the one in service.
        pinned: versions that are never deleted.
        origins: of bundles by version, where they are known.
        keys: fingerprints by version of the bundle keys that recalibrations were made under.
    """

    history: tuple[str | None, ...] = (None,)
    cursor: int = 0
    pinned: frozenset[str] = frozenset()
    origins: Mapping[str, Origin] = field(default_factory=dict)
    keys: Mapping[str, str] = field(default_factory=dict)


class ModelStore:
    """A folder of bundles descended from one base bundle.

    Args:
        folder: made if absent.
        base: the bundle that the operator gave; another base has its own history.
        kept: how many of the newest bundles `prune` leaves.
        clock: by which it is tried again now and then.

    Attributes:
        note: as it was read or written last.

    Raises:
        StoreError: the folder cannot be made.
    """

    def __init__(
        self, folder: Path, base: Bundle, kept: int = KEPT_BUNDLES, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.folder, self._kept, self._clock = folder, kept, clock
        self._base = sha256(base.manifest.to_json())
        self._lock_file: int | None = None
        self._writing = threading.Lock()
        self._guard = threading.Lock()
        """Guards what is known of the store's state."""
        self._damage: Trouble | None = None
        self._failure: Trouble | None = None
        self._probed = -float("inf")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StoreError(self._subject, error, "a folder that can be written") from None
        try:
            self.note = self.read()
        except BundleError as error:
            self.note = Note()
            self.damaged(Reason.NOTE, error)

    @property
    def _subject(self) -> str:
        return f"model store {self.folder}"

    def path_of(self, version: str) -> Path:
        """Where the bundle of this version is or will be."""
        return self.folder / f"{version}.zip"

    def versions(self) -> list[str]:
        """Versions that exist here."""
        return sorted(path.name.removesuffix(".zip") for path in self._bundles())

    def origin(self, version: str) -> Origin | None:
        """Where the bundle of this version came from, None where that is not known."""
        known = self.note.origins.get(version)
        return known or (Origin.RECALIBRATED if "+r" in version else None)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other services out of the store, and sweep it first.

        Raises:
            StoreError: another service uses it.
        """
        self._lock_file = self._open_lock()
        try:
            if self._lock_file is not None:
                try:
                    fcntl.flock(self._lock_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    got, expected = "a store in use", "one that no other service uses"
                    raise StoreError(self._subject, got, expected) from None
                except OSError as error:
                    _log.warning("%s: cannot be locked: %s", self._subject, error)
            self.sweep()
            yield
        finally:
            if self._lock_file is not None:
                os.close(self._lock_file)
                self._lock_file = None

    def sweep(self) -> None:
        """Remove what programs that were killed have left: unfinished bundles and uploads."""
        for pattern in _LEFTOVERS:
            for path in self.folder.glob(pattern):
                try:
                    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
                except OSError as error:
                    _log.warning("%s: %s stays: %s", self._subject, path.name, error)
                else:
                    _log.info("%s: removed %s, which was left unfinished", self._subject, path.name)

    def surplus(self, held: Collection[Path]) -> list[Path]:
        """Bundles that `prune` would delete."""
        own = [path for path in self._bundles() if self.origin(path.name.removesuffix(".zip")) is not None]
        newest_first = sorted(own, key=lambda path: path.stat().st_mtime_ns, reverse=True)
        return [path for path in newest_first[self._kept :] if path not in held]

    def prune(self, held: Collection[Path]) -> list[Path]:
        """Delete all but the newest bundles and those `held`; returns what was deleted."""
        dropped = self.surplus(held)
        for path in dropped:
            path.unlink(missing_ok=True)
            signature_path(path).unlink(missing_ok=True)
        return dropped

    def change(self, **changes: Any) -> None:
        """Change fields of the note and write it; a crash or power cut leaves one note, whole.

        Raises:
            StoreError: it cannot be written; then it stays as it was.
        """
        with self._writing:
            note = replace(self.note, **changes)
            data: dict[str, Any] = {
                "base": self._base,
                "history": note.history,
                "cursor": note.cursor,
                "pinned": sorted(note.pinned),
                "origins": dict(sorted(note.origins.items())),
            }
            if note.keys:
                data["keys"] = dict(sorted(note.keys.items()))
            try:
                self._check_folder()
                self._keep_damaged()
                replace_text(self.folder / CURRENT, json.dumps(data))
            except OSError as error:
                raise self.failed(error) from None
            except LightpageError as error:
                cause = error.__context__  # what the system said
                raise self.failed(cause if isinstance(cause, OSError) else OSError(error.got)) from None
            self.note = note
        with self._guard:
            self._failure = None

    def _keep_damaged(self) -> None:
        """Set a damaged note aside, before a new one takes its place."""
        with self._guard:
            damaged = self._damage is not None and self._damage.reason is Reason.NOTE
        if damaged and self.has_note:
            os.replace(self.folder / CURRENT, self.folder / DAMAGED)
            _log.warning("%s: a new note is written; the damaged one is %s now", self._subject, DAMAGED)

    @property
    def has_note(self) -> bool:
        """Whether there is a note, whole or not."""
        return (self.folder / CURRENT).exists()

    def read(self) -> Note:
        """The note, without a history where there is none or another base's.

        Raises:
            BundleError: it is damaged, or gone while there are bundles that a service made.
        """
        subject = f"{self._subject}: {CURRENT}"
        try:
            data = json.loads((self.folder / CURRENT).read_text("utf-8"))
            base, history, cursor = data["base"], tuple(data["history"]), int(data["cursor"])
            pinned = frozenset(map(str, data["pinned"]))
            origins = {version: Origin(origin) for version, origin in data["origins"].items()}
            keys = {version: str(key) for version, key in data.get("keys", {}).items()}
        except FileNotFoundError:
            if made := [version for version in self.versions() if "+r" in version]:
                raise BundleError(subject, "no such file", f"a note: there is {', '.join(made)}") from None
            return Note()
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise BundleError(subject, repr(error), "a note that can be read") from None
        if base != self._base:
            return Note(pinned=pinned, origins=origins, keys=keys)
        if not 0 <= cursor < len(history):
            raise BundleError(subject, f"bundle {cursor} of {len(history)} in service", "one of them")
        for each in history:
            if each is not None and not (isinstance(each, str) and Path(each).name == each and each.endswith(".zip")):
                raise BundleError(subject, repr(each), "the name of a bundle")
        return Note(history, cursor, pinned, origins, keys)

    def damaged(self, reason: Reason, error: LightpageError) -> None:
        """Say that the note or the bundle that was in service is lost; so it stays until `settled`."""
        with self._guard:
            self._damage = Trouble(reason, str(error))

    def settled(self) -> None:
        """Say that what is in service was changed and noted: what was lost counts no more."""
        with self._guard:
            self._damage = None

    @property
    def is_damaged(self) -> bool:
        """Whether it is not as it was left, and nobody has settled yet what is to be in service."""
        with self._guard:
            return self._damage is not None

    def check(self, needed_bytes: int) -> None:
        """Try whether the store can be written and has room.

        Raises:
            StoreError: it cannot, or has not.
        """
        with self._guard:
            self._probed = self._clock()
        try:
            self._probe(needed_bytes)
        except OSError as error:
            raise self.failed(error) from None
        with self._guard:
            self._failure = None

    def failed(self, error: OSError) -> StoreError:
        """Remember that the store cannot be written; returns the error that says so."""
        told = StoreError(self._subject, error, "a folder that can be written and has room")
        reason = _REASONS.get(error.errno or 0, Reason.FAILED)
        with self._guard:
            is_new = self._failure is None
            self._failure = Trouble(reason, str(told))
        if is_new:
            _log.warning("%s", told)
        return told

    def trouble(self, needed_bytes: int) -> Trouble | None:
        """What is wrong with the store, None where nothing is; it is tried again where that was long ago."""
        if self._clock() - self._probed >= PROBE_S:
            with suppress(StoreError):
                self.check(needed_bytes)
        return self.known_trouble()

    def known_trouble(self) -> Trouble | None:
        """What was wrong with the store when it was tried last; its disk is left alone."""
        with self._guard:
            return self._failure or self._damage

    def _bundles(self) -> list[Path]:
        return [path for path in self.folder.glob("*.zip") if not path.name.startswith(".")]

    def _open_lock(self) -> int | None:
        """The lock file; None, with a warning, where a store cannot be written and has none."""
        path = self.folder / LOCK
        try:
            return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            with suppress(OSError):
                return os.open(path, os.O_RDONLY)
            _log.warning("%s: cannot be locked: %s", self._subject, error)
            return None

    def _check_folder(self) -> None:
        """Check that the folder is the one that was locked: under a disk that is gone there may be an empty one."""
        if self._lock_file is not None:
            here, own = os.stat(self.folder / LOCK), os.fstat(self._lock_file)
            if (here.st_dev, here.st_ino) != (own.st_dev, own.st_ino):
                raise FileNotFoundError(errno.ENOENT, "another folder than at the start")

    def _probe(self, needed_bytes: int) -> None:
        self._check_folder()
        descriptor, name = new_file(self.folder, PROBE.strip(".-"))
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(bytes(4096))
                file.flush()
                synchronise(file.fileno())
        finally:
            os.unlink(name)
        if (free := shutil.disk_usage(self.folder).free) < needed_bytes:
            raise OSError(errno.ENOSPC, f"{free} bytes free, {needed_bytes} needed")


_REASONS = {
    errno.ENOSPC: Reason.FULL,
    errno.EDQUOT: Reason.FULL,
    errno.EROFS: Reason.READ_ONLY,
    errno.EACCES: Reason.READ_ONLY,
    errno.EPERM: Reason.READ_ONLY,
    errno.ENOENT: Reason.GONE,
    errno.ENOTDIR: Reason.GONE,
    errno.ESTALE: Reason.GONE,
    errno.ENODEV: Reason.GONE,
}
