"""A folder where bundles are put for the service to take in."""

import logging
import os
import threading
from pathlib import Path
from typing import Self

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import BusyError, CallerLeft, LightpageError, StoreError
from lightpage.runtime.client.wire.messages import CHUNK_BYTES
from lightpage.runtime.model.bundle.signature_file import read_signature, signature_path
from lightpage.runtime.service.admission import Slots
from lightpage.runtime.service.caller import Actor, Caller
from lightpage.runtime.service.limits import GRACE_S
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.uploads import Upload

_log = logging.getLogger(__name__)

LOOK_S = 5.0
"""How often the folder is looked at; a file that has not changed since the last time is whole."""

_Stamp = tuple[tuple[int, int, int], tuple[int, int, int] | None]
"""Number, size and time of change of a bundle, and of its signature where it has one."""


class Incoming:
    """A thread that moves bundles from a folder to the store, as uploads; to be used in a `with` statement.

    A bundle that is refused stays where it is, and is not tried again before it changes. Where the store cannot take
    it, it is.

    Args:
        models: models of a service that has a store.
        most_bytes: largest size of a bundle.
        uploads: the slot for one.
        folder: is looked at for files that end in .zip.
        look_s: how often.
        clock: clock by which it waits between two looks.
    """

    def __init__(
        self,
        models: Models,
        most_bytes: int,
        uploads: Slots,
        folder: Path,
        look_s: float = LOOK_S,
        clock: Clock = SYSTEM,
    ) -> None:
        self._models, self._most_bytes, self._uploads = models, most_bytes, uploads
        self._folder, self._look_s, self._clock = folder, look_s, clock
        self._seen: dict[Path, _Stamp] = {}
        self._told: dict[Path, tuple[_Stamp, bool]] = {}
        """What was said to fail, and whether it is tried again."""
        self._caller, self._stopping = Caller(actor=Actor("incoming folder")), threading.Event()
        self._thread = threading.Thread(target=self._run, name="lightpage-incoming", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._caller.leave()
        self._thread.join(GRACE_S)

    def look(self) -> None:
        """Take in what is new and whole."""
        seen = {path: stamp for path in sorted(self._folder.glob("[!.]*.zip")) if (stamp := _stamp(path)) is not None}
        for path, stamp in seen.items():
            if self._seen.get(path) == stamp and self._told.get(path) != (stamp, False):
                self._take(path, stamp)
        self._seen = seen
        self._told = {path: told for path, told in self._told.items() if path in seen}

    def _run(self) -> None:
        while not self._clock.wait(self._stopping, self._look_s):
            try:
                self.look()
            except CallerLeft:
                return
            except Exception:
                _log.exception("incoming: %s cannot be looked at", self._folder)

    def _take(self, path: Path, stamp: _Stamp) -> None:
        try:
            version = self._take_in(path)
        except (LightpageError, OSError) as error:
            told = stamp, isinstance(error, StoreError | BusyError)
            if self._told.get(path) != told:
                how = "left for later" if told[1] else "refused"
                _log.warning("incoming: %s is %s: %s", path.name, how, error)
            self._told[path] = told
        else:
            _log.info("incoming: %s is in the store as %s", path.name, version)

    def _take_in(self, path: Path) -> str:
        """Move a bundle to the store; returns its version."""
        with path.open("rb") as file, self._uploads.held_at_once():
            size, signature = os.fstat(file.fileno()).st_size, read_signature(path)
            upload = Upload(self._models, self._most_bytes, self._caller, size, signature=signature)
            try:
                upload.begin()
                while chunk := file.read(CHUNK_BYTES):
                    upload.add(chunk)
                entry = upload.finish()
            finally:
                upload.drop()
        path.unlink(missing_ok=True)
        signature_path(path).unlink(missing_ok=True)
        return entry.manifest.version


def _stamp(path: Path) -> _Stamp | None:
    """Return what changes with a bundle or its signature; None for what is no bundle, or is gone."""
    bundle = _file_stamp(path)
    return None if bundle is None else (bundle, _file_stamp(signature_path(path)))


def _file_stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        found = path.lstat()
    except OSError:
        return None
    return (found.st_ino, found.st_size, found.st_mtime_ns) if path.is_file() and not path.is_symlink() else None
