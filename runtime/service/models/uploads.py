"""Bundles that come from elsewhere: received into the store in pieces, checked, and given their names."""

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lightpage.errors import BundleError, CallerLeft, InvalidInputError, LimitError, ModelExistsError, StoreError
from lightpage.files import give_new_name, new_file, sync_folder, synchronise
from lightpage.runtime.model.bundle.signature_file import MOST_BYTES, signature_path
from lightpage.runtime.service.caller import NOBODY, Actor, Caller
from lightpage.runtime.service.models.folder import UPLOAD
from lightpage.runtime.service.models.history import Origin, State
from lightpage.runtime.service.models.models import ModelEntry, Models


def take_in(
    models: Models, path: Path, actor: Actor = NOBODY, here: Callable[[], None] = lambda: None, signature: bytes = b""
) -> ModelEntry:
    """Check a bundle that lies in the store under another name, and give it its own.

    Args:
        models: models that it is added to.
        path: path of the zip.
        actor: who brings it, for the record.
        here: called before it gets its name; what it raises leaves it as it is.
        signature: signature of the zip, which is kept beside it where it was asked for; empty for none.

    Raises:
        StoreError: the store cannot be written.
        ModelExistsError: there is a model of its version.
        BundleError: it is damaged, for another device, or lacks the signature that it needs.
    """
    loader, folder = models.loader, models.store.folder
    with models.recorded("upload", actor):
        current = models.current.decoder
        try:
            decoder = loader.opened(path, current, signature)
            loader.tracked(decoder, current)  # as if it were put in service
        except BundleError as error:
            subject = error.subject.replace(f"bundle {path}", "new bundle")
            raise type(error)(subject, error.got, error.expected) from None
    version, taken = decoder.version, False
    final = folder.bundle(version)

    def named(state: State) -> tuple[State, None]:
        nonlocal taken
        try:
            if version in models.versions():
                raise FileExistsError
            here()
            give_new_name(path, final)  # unlike a renaming, it replaces nothing that came in the meantime
        except FileExistsError:
            expected = "one that the service does not have"
            raise ModelExistsError("new bundle: version", version, expected) from None
        taken = True
        if loader.wants_signatures:
            with signature_path(final).open("wb") as file:
                file.write(signature)
                file.flush()
                synchronise(file.fileno())
        sync_folder(final.parent)
        return state.among(models.versions()).noting(version, origin=Origin.UPLOADED, key=None), None

    try:
        models.change("upload", actor, named, version)
    except BaseException:
        if taken:
            folder.delete(version)
        raise
    with suppress(OSError):  # the next start sweeps it; its two names told that it was not taken in yet
        path.unlink()
    models.prune(version)
    return models.entry(decoder.bundle.manifest)


class Upload:
    """A bundle that comes in pieces into a hidden file of the store. It is dropped unless `finish` returns.

    Args:
        models: models that it is added to.
        most_bytes: largest size of its zip.
        caller: sender of the bundle.
        size: size of its zip, bytes.
        digest: SHA-256 of the zip, empty where it is not known.
        signature: signature of the zip; empty for none.

    Raises:
        StoreError: there is no store.
        LimitError: it is too large.
        InvalidInputError: an impossible size, hash or signature.
    """

    def __init__(
        self, models: Models, most_bytes: int, caller: Caller, size: int, digest: bytes = b"", signature: bytes = b""
    ) -> None:
        if not models.store.folder.is_kept:
            raise StoreError("model store", "none", "a service started with --store")
        if size == 0:
            raise InvalidInputError("header.bytes", 0, "the size of the zip")
        if size > most_bytes:
            raise LimitError("uploaded model", f"{size} bytes", f"at most {most_bytes}")
        if len(digest) not in (0, 32):
            raise InvalidInputError("header.sha256", f"{len(digest)} bytes", "32, or none")
        if len(signature) > MOST_BYTES:
            raise InvalidInputError("header.signature", f"{len(signature)} bytes", f"at most {MOST_BYTES}")
        self._models, self._caller, self._size, self._digest, self._signature = models, caller, size, digest, signature
        self._hash, self._come = hashlib.sha256(), 0
        self._path, self._dropped = Path(), False

    def begin(self) -> None:
        """Make the file.

        Raises:
            StoreError: the store cannot be written, or has no room.
        """
        with self._at_work():
            self._models.store.check(self._size)
            descriptor, self._path = new_file(self._models.store.folder.path, UPLOAD.strip(".-"))
            os.close(descriptor)

    def add(self, data: bytes) -> None:
        """Take the next piece.

        Raises:
            InvalidInputError: more than was announced.
            StoreError: it cannot be written.
        """
        with self._at_work():
            if self._come + len(data) > self._size:
                come = f"at least {self._come + len(data)} bytes"
                raise InvalidInputError("uploaded model", come, f"{self._size}, as announced")
            self._hash.update(data)
            with self._path.open("r+b") as file:  # it is not made again where somebody drops it
                file.seek(self._come)
                self._come += file.write(data)

    def finish(self) -> ModelEntry:
        """Check the bundle and take it in.

        Raises:
            InvalidInputError: less than was announced.
            BundleError: it is damaged, foreign, or there already; see `take_in`.
            CallerLeft: the caller has gone.
        """
        with self._at_work():
            if self._come != self._size:
                raise InvalidInputError("uploaded model", f"{self._come} bytes", f"{self._size}, as announced")
            if self._digest and self._hash.digest() != self._digest:
                found = self._hash.hexdigest()
                raise BundleError("uploaded model: SHA-256", found, f"{self._digest.hex()}, as announced")
            return take_in(self._models, self._path, self._caller.actor, self._check_here, self._signature)

    def drop(self) -> None:
        """Remove what has come, also while a piece of it is at work; the bundle stays if it was taken in."""
        self._dropped = True
        with suppress(OSError):  # the next start sweeps it
            if self._path.name:
                self._path.unlink()

    def _check_here(self) -> None:
        self._caller.check()
        if self._dropped:
            raise CallerLeft

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        try:
            self._check_here()
            yield
        except OSError as error:
            self._check_here()
            raise self._models.store.failed(error) from None
        finally:
            if self._dropped:  # perhaps before there was a file
                self.drop()
