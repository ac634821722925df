"""The folder of a service's bundles: it is locked, swept of what killed programs have left, and tried now and then."""

import errno
import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Collection
from pathlib import Path

from lightpage.errors import StoreError, SurroundingsError, raised_as
from lightpage.files import lock, new_file, synchronise
from lightpage.runtime.model.bundle.signature_file import signature_path
from lightpage.runtime.service.models.database import DATABASE
from lightpage.systems import open_file
from lightpage.temporary import temporary_folder

_log = logging.getLogger(__name__)

LOCK = ".lock"
UPLOAD = ".upload-"
"""How the name of an unfinished upload begins."""
PROBE = ".probe-"
"""How the name of a file begins that tries whether the folder can be written."""
_LEFTOVERS = (f"{UPLOAD}*", f"{PROBE}*", f".{DATABASE}-*", ".*.json-*", ".*.zip-*")
"""Names of what a program that was killed leaves here."""

_PREFIX = "lightpage-models-"


class BundleFolder:
    """A folder that one service at a time uses; without a path a temporary one, made when it is first asked for.

    Args:
        path: made if absent; None for a temporary folder.

    Attributes:
        is_kept: whether it outlives the service.
        has_locks: whether its file system has locks.

    Raises:
        StoreError: it cannot be made or locked, or another service uses it.
    """

    def __init__(self, path: Path | None) -> None:
        self._path, self.is_kept, self.has_locks = path, path is not None, True
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        self._making = threading.Lock()
        self._lock: int | None = None
        if path is not None:
            try:
                path.mkdir(parents=True, exist_ok=True)
                self._take(path)
            except BlockingIOError:
                self.close()
                raise StoreError(self.subject, "a store in use", "one that no other service uses") from None
            except OSError as error:
                self.close()
                raise StoreError(self.subject, error, "a folder that can be written") from None

    @property
    def subject(self) -> str:
        """Return what an error says that it is about."""
        return f"model store {self._path}"

    @property
    def path(self) -> Path:
        """Return where it is.

        Raises:
            StoreError: there is no temporary folder that can be written.
        """
        with self._making, raised_as(StoreError, SurroundingsError):
            if self._path is None:
                self._temporary = temporary_folder("recalibrated models of a service without --store", _PREFIX)
                self._path = Path(self._temporary.name)
            return self._path

    def close(self) -> None:
        """Let go of it; a temporary one is dropped."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        if self._temporary is not None:
            self._temporary.cleanup()

    def bundle(self, version: str) -> Path:
        """Return where the bundle of this version is or will be."""
        return self.path / f"{version}.zip"

    def versions(self) -> list[str]:
        """Versions that exist here."""
        found = [] if self._path is None else self._path.glob("[!.]*.zip")
        return sorted(path.name.removesuffix(".zip") for path in found)

    def newest_first(self, own: Callable[[str], bool]) -> list[str]:
        """Return the versions of bundles that are the service's `own`, the newest first; `OSError` where that fails."""
        written_ns = {version: self.bundle(version).stat().st_mtime_ns for version in self.versions() if own(version)}
        return sorted(written_ns, key=written_ns.__getitem__, reverse=True)

    def delete(self, version: str) -> None:
        """Delete a bundle with its signature; `OSError` where it stays."""
        for path in (self.bundle(version), signature_path(self.bundle(version))):
            path.unlink(missing_ok=True)

    def check(self) -> None:
        """Raise `OSError` unless it is the one that was locked: under a disk that is gone there may be an empty one."""
        if self._lock is not None and not os.path.samestat(os.stat(self.path / LOCK), os.fstat(self._lock)):
            raise FileNotFoundError(errno.ENOENT, "another folder than at the start")

    def probe(self, needed_bytes: int = 0) -> None:
        """Raise `OSError` where it cannot be written, or has no room."""
        self.check()
        descriptor, name = new_file(self.path, PROBE.strip(".-"))
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(bytes(4096))
                file.flush()
                synchronise(file.fileno())
        finally:
            os.unlink(name)
        if (free := shutil.disk_usage(self.path).free) < needed_bytes:
            raise OSError(errno.ENOSPC, f"{free} bytes free, {needed_bytes} needed")

    def sweep(self, noted: Collection[str], is_sure: bool) -> None:
        """Remove what programs that were killed have left.

        Args:
            noted: versions of bundles of which something is known.
            is_sure: whether that is all: then a bundle that was about to be taken in, and is not noted, goes too.
        """
        if self._path is None:
            return
        for path in (path for pattern in _LEFTOVERS for path in self._path.glob(pattern)):
            try:
                for version in self.versions() if is_sure and path.lstat().st_nlink > 1 else ():
                    if version not in noted and path.samefile(self.bundle(version)):
                        self.delete(version)
                shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
            except OSError as error:
                _log.warning("%s: %s stays: %s", self.subject, path.name, error)
            else:
                _log.info("%s: removed %s, which was left unfinished", self.subject, path.name)

    def _take(self, folder: Path) -> None:
        """Lock the folder, where that can be done; see whether SQLite, which locks ranges of bytes, can."""
        path = folder / LOCK
        try:
            self._lock = open_file(path)
        except OSError as error:
            if not path.exists():  # nobody can write there, and nobody ever has
                _log.warning("%s: cannot be locked: %s", self.subject, error)
                return
            self._lock = os.open(path, os.O_RDONLY)
        try:
            self.has_locks = lock(self._lock, self.subject)
            descriptor, name = new_file(folder, PROBE.strip(".-"))  # shares let no file have locks of both kinds
        except BlockingIOError:
            raise
        except OSError as error:
            _log.warning("%s: locks cannot be tried: %s", self.subject, error)
            return
        try:
            self.has_locks &= lock(descriptor, self.subject, ranges=True)
        finally:
            os.close(descriptor)
            os.unlink(name)
