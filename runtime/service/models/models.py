"""The models of a service, those that are loaded and those of its store: which of them decodes, how more come in."""

from __future__ import annotations

import hashlib
import logging
import os
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import (
    BundleError,
    CallerLeft,
    InvalidInputError,
    LightpageError,
    LimitError,
    ModelExistsError,
    StorageError,
    StoreError,
    SurroundingsError,
)
from lightpage.files import new_file, sync_folder, synchronise
from lightpage.runtime.model.bundle.bundle import read_manifest
from lightpage.runtime.model.bundle.manifest import Manifest, check_version
from lightpage.runtime.model.bundle.signature_file import MOST_BYTES, signature_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.admission import Slots
from lightpage.runtime.service.caller import NOBODY, Actor, Caller
from lightpage.runtime.service.limits import Limits
from lightpage.runtime.service.models.audit import AuditLog
from lightpage.runtime.service.models.registry import History, Model, ModelRegistry, Place
from lightpage.runtime.service.models.store import UPLOAD, ModelStore, Note, Origin, Reason, Trouble
from lightpage.runtime.service.models.store_health import StoreHealth

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ModelEntry:
    """What is known of a model.

    Attributes:
        manifest: of its bundle.
        current: whether it decodes now.
        pinned: whether it is never deleted.
        loaded: whether it is loaded.
        origin: where it came from, None where that is not known.
    """

    manifest: Manifest
    current: bool
    pinned: bool
    loaded: bool
    origin: Origin | None


class Models:
    """Changes which model decodes, remembers it, and takes in new ones. Every method may be called from many threads.

    Args:
        registry: the models.
        store: where they are kept, or None.
        limits: of uploads.
        in_service: is told which model is about to be in service.
        audit: is told of every change, and of those that failed.
        clock: by which a store that hangs is known.

    Attributes:
        store_health: tells of the store without waiting for its disk.
        uploads: the one slot for uploads.
    """

    def __init__(
        self,
        registry: ModelRegistry,
        store: ModelStore | None,
        limits: Limits,
        in_service: Callable[[Model], None],
        audit: AuditLog | None = None,
        clock: Clock = SYSTEM,
    ) -> None:
        self._audit, self._changing = audit or AuditLog(), threading.RLock()
        self.registry, self.store = registry, store
        self.limits, self._in_service = limits, in_service
        self.uploads = Slots(1, "uploads of models", limits.deadline_s, clock)
        self._own_note = Note()
        self.store_health = StoreHealth(self.trouble, clock=clock)
        registry.made_under = self._made_under
        self._noting = threading.RLock()
        """Held while the note is changed; taken after the registry's lock and before the store's."""
        self._uploading = threading.Lock()
        """Held while a version is looked for and taken."""

    def adopt(self, decoder: Decoder, expected: Model | None = None, actor: Actor = NOBODY) -> Model:
        """Remember a recalibrated decoder and put it in service: both or neither.

        Raises:
            BundleError: it cannot be remembered, or see `ModelRegistry.swap`.
            RecalibrationRefusedError: see `ModelRegistry.swap`.
        """

        def note(model: Model, history: History) -> None:
            with self._noting:
                self._remember(**self._history(history), **self._made(model.version, Origin.RECALIBRATED))
            self._begin(model)

        with self._audited("recalibrate", actor, decoder.version):
            return self.registry.swap(decoder, expected, note)

    def rollback(self, expected: str = "", actor: Actor = NOBODY) -> tuple[Model, Model]:
        """Remember the model before and go back to it; returns (now current, before).

        Args:
            expected: version that must be in service; empty for any.
            actor: who does it, for the record.

        Raises:
            BundleError: there is none, it is damaged, or it cannot be remembered; then nothing changes.
            OtherModelError: another version is in service.
        """
        with self._audited("rollback", actor):
            return self.registry.step(-1, expected, self._note)

    def roll_forward(self, expected: str = "", actor: Actor = NOBODY) -> tuple[Model, Model]:
        """The opposite of `rollback`; raises as that does."""
        with self._audited("roll forward", actor):
            return self.registry.step(1, expected, self._note)

    def activate(self, version: str, expected: str = "", actor: Actor = NOBODY) -> tuple[Model, Model]:
        """Remember a model and put it in service; returns (now current, before).

        Args:
            version: of it.
            expected: version that must be in service; empty for any.
            actor: who does it, for the record.

        Raises:
            BundleError: there is none, it is damaged or foreign, or it cannot be remembered; then nothing changes.
            OtherModelError: another version is in service.
        """
        with self._audited("activate", actor, version):
            return self.registry.go_to(self._place(version), expected, self._note)

    def pin(self, version: str, pinned: bool, actor: Actor = NOBODY) -> ModelEntry:
        """Pin a model, or let go of it.

        Raises:
            BundleError: there is none, or it cannot be remembered.
        """
        manifest = self._manifest(self._place(version))
        with self._audited("pin" if pinned else "unpin", actor, version), self._noting:
            held = self._noted.pinned
            self._remember(pinned=held | {version} if pinned else held - {version})
        return self._entry(manifest)

    @contextmanager
    def _audited(self, what: str, actor: Actor, version: str = "") -> Iterator[None]:
        """Write down a change of the model in service, or of `version`, or that it failed."""
        with self._changing:
            before = self.registry.current.version
            try:
                yield
            except Exception as error:
                told = str(error) or repr(error)
                self._audit.record(what, before, version, actor=actor, outcome="failed", detail=told)
                raise
            self._audit.record(what, before, version or self.registry.current.version, actor=actor)

    def record_upload(self, version: str, actor: Actor, error: Exception | None = None) -> None:
        """Write down what was taken in, or that it failed."""
        outcome, told = ("done", "") if error is None else ("failed", str(error) or repr(error))
        current = self.registry.current.version
        self._audit.record("upload", current, version, actor=actor, outcome=outcome, detail=told)

    @property
    def current_pinned(self) -> bool:
        """Whether the model in service is pinned."""
        return self.registry.current.version in self._noted.pinned

    def entry(self, model: Model) -> ModelEntry:
        """What is known of a loaded model."""
        return self._entry(model.decoder.bundle.manifest)

    def entries(self, stored: bool = False) -> list[ModelEntry]:
        """The models that are loaded, the oldest first; before them those that are not, if they are `stored` somewhere.

        Bundles of the store that cannot be read are left out.
        """
        loaded = [model.decoder.bundle.manifest for model in self.registry.models]
        versions = {manifest.version for manifest in loaded}
        others = list(self._stored(versions)) if stored else []
        return [self._entry(manifest) for manifest in (*others, *loaded)]

    def versions(self) -> list[str]:
        """Versions that were in service, or are in the store: none of them is given again."""
        stored = self.store.versions() if self.store is not None else []
        return [self.registry.base.version, *(place.version for place in self.registry.history.places), *stored]

    def resume(self) -> None:
        """Go on with what the store remembers, as far as it can be used; what cannot is logged and is its trouble."""
        store, base = self.store, self.registry.base
        if store is None:
            return
        try:
            note = store.read()
        except BundleError as error:
            _log.warning("serving the base: %s", error)
            store.damaged(Reason.NOTE, error)
            return
        places = [
            base if name is None else Place(name.removesuffix(".zip"), store.folder / name) for name in note.history
        ]
        gone = dict.fromkeys(place for place in places if place != base and not place.path.exists())
        history = History(tuple(places), note.cursor).without(gone)
        gone.pop(history.current, None)  # an attempt to load it says so
        errors: list[LightpageError] = [
            BundleError(f"bundle {place.path}", "nothing", "a bundle that was in service") for place in gone
        ]
        for cursor in range(history.cursor, -1, -1):
            try:
                self.registry.resume(History(history.places, cursor))
                break
            except (BundleError, StorageError, SurroundingsError) as error:
                errors.append(error)
        model = self.registry.current
        for lost in errors:
            store.damaged(Reason.BUNDLE, lost)
            given = " as it was given" if model.version == base.version else ""
            _log.warning("serving %s%s: %s", model.version, given, lost)
        self._in_service(model)
        if not store.has_note:
            with suppress(StoreError):  # logged, and in its trouble
                store.change()

    def check_store(self, needed_bytes: int = 0) -> None:
        """Check that the store can take a bundle: twice that in service, or `needed_bytes` if that is more.

        Raises:
            StoreError: it cannot be written, or has no room.
        """
        if self.store is not None:
            self.store.check(max(self._room_bytes, needed_bytes))

    def trouble(self) -> Trouble | None:
        """What is wrong with the store, None where nothing is, or where there is none.

        It may take as long as the disk does: now and then the store is tried.
        """
        return None if self.store is None else self.store.trouble(self._room_bytes)

    def upload(self, size: int, digest: bytes, caller: Caller, signature: bytes = b"") -> Upload:
        """A bundle that is about to come.

        Args:
            size: bytes of its zip.
            digest: SHA-256 of it, empty where that is not known.
            caller: who sends it.
            signature: of the zip; empty for none.

        Raises:
            StoreError: there is no store.
            LimitError: it is too large.
            InvalidInputError: an impossible size, hash or signature.
        """
        if self.store is None:
            raise StoreError("model store", "none", "a service started with --store")
        if size == 0:
            raise InvalidInputError("header.bytes", 0, "the size of the zip")
        if size > self.limits.model_bytes:
            raise LimitError("uploaded model", f"{size} bytes", f"at most {self.limits.model_bytes}")
        if len(digest) not in (0, 32):
            raise InvalidInputError("header.sha256", f"{len(digest)} bytes", "32, or none")
        if len(signature) > MOST_BYTES:
            raise InvalidInputError("header.signature", f"{len(signature)} bytes", f"at most {MOST_BYTES}")
        return Upload(self, self.store, size, digest, caller, signature)

    def take_in(self, path: Path, here: Callable[[], None] = lambda: None, signature: bytes = b"") -> ModelEntry:
        """Check a bundle that lies in the store under another name, and give it its own.

        Args:
            path: of the zip.
            here: called before it gets its name; what it raises leaves it as it is.
            signature: of the zip, which is kept beside it where it was asked for; empty for none.

        Raises:
            StoreError: there is no store, or it cannot be written.
            ModelExistsError: there is a model of its version.
            BundleError: it is damaged, for another device, or lacks the signature that it needs.
        """
        store = self.store
        if store is None:
            raise StoreError("model store", "none", "a service started with --store")
        try:
            decoder = self.registry.opened(path, signature)
            self.registry.tracked(decoder)  # as if it were put in service
        except BundleError as error:
            subject = error.subject.replace(f"bundle {path}", "new bundle")
            raise type(error)(subject, error.got, error.expected) from None
        version = decoder.version
        final = store.path_of(version)
        with self._uploading:
            if version in self.versions():
                raise ModelExistsError("new bundle: version", version, "one that the service does not have")
            here()
            try:
                os.link(path, final)  # fails where a rename would replace what came in the meantime
                if self.registry.wants_signatures:
                    _write_beside(signature_path(path), signature)
                    os.replace(signature_path(path), signature_path(final))
                sync_folder(store.folder)
            except FileExistsError:
                expected = "one that the service does not have"
                raise ModelExistsError("new bundle: version", version, expected) from None
            except OSError as error:
                final.unlink(missing_ok=True)
                signature_path(path).unlink(missing_ok=True)
                raise store.failed(error) from None
        try:
            with self._noting:
                self._remember(**self._made(version, Origin.UPLOADED))
        except BaseException:
            final.unlink(missing_ok=True)
            signature_path(final).unlink(missing_ok=True)
            raise
        path.unlink(missing_ok=True)
        self.prune(store, [final])
        return self._entry(decoder.bundle.manifest)

    def prune(self, store: ModelStore, more: Collection[Path] = ()) -> None:
        """Delete the oldest bundles of a store, but none that is loaded, pinned, or one of `more`."""
        if store is self.store and store.is_damaged:  # what is still there may be needed
            return
        try:
            surplus = store.surplus(self._held(store, more))
            self.registry.forget(surplus, lambda history: self._remember(**self._history(history)))
            with self._noting:  # nobody pins one meanwhile
                dropped = store.prune(self._held(store, more))
        except (OSError, StoreError) as error:  # the models serve all the same
            _log.warning("model store %s: old bundles stay: %s", store.folder, error)
        else:
            for path in dropped:
                _log.info("model store %s: dropped %s", store.folder, path.name)

    def _held(self, store: ModelStore, more: Collection[Path]) -> set[Path]:
        """Bundles that are loaded, pinned, or one of `more`."""
        loaded = (model.decoder.bundle.path for model in self.registry.models)
        return {*loaded, *more, *(store.path_of(version) for version in self._noted.pinned)}

    @property
    def _noted(self) -> Note:
        return self._own_note if self.store is None else self.store.note

    def _remember(self, **changes: Any) -> None:
        """Change the note, that of the store where there is one."""
        with self._noting:
            if self.store is None:
                self._own_note = replace(self._own_note, **changes)
            else:
                self.store.change(**changes)

    def _note(self, model: Model, history: History) -> None:
        self._remember(**self._history(history))
        self._begin(model)

    def _begin(self, model: Model) -> None:
        if self.store is not None:
            self.store.settled()
        self._in_service(model)

    def _history(self, history: History) -> dict[str, Any]:
        """A history as fields of the note."""
        folder = None if self.store is None else self.store.folder
        names = tuple(place.path.name if place.path.parent == folder else None for place in history.places)
        return {"history": names, "cursor": history.cursor}

    def _made(self, version: str, origin: Origin) -> dict[str, Any]:
        """Fields of the note that say where bundles come from, with one more, and without those that are gone."""
        others, note = {*self.versions()} - {version}, self._noted
        origins = {name: value for name, value in note.origins.items() if name in others} | {version: origin}
        keys = {name: value for name, value in note.keys.items() if name in others}
        if origin is Origin.RECALIBRATED and (key := self.registry.key_fingerprint):
            keys[version] = key
        return {"origins": origins, "keys": keys}

    def _made_under(self, version: str) -> str | None:
        """As `ModelRegistry.made_under`."""
        note = self._noted
        return note.keys.get(version, "") if note.origins.get(version) is Origin.RECALIBRATED else None

    def _place(self, version: str) -> Place:
        """Where a model is that is loaded, was in service, or is in the store."""
        check_version(version, "model")
        for place in (self.registry.base, *self.registry.history.places):
            if place.version == version:
                return place
        if self.store is not None and (path := self.store.path_of(version)).is_file():
            return Place(version, path)
        raise BundleError("model", f"no {version}", "the version of a model that the service has")

    def _manifest(self, place: Place) -> Manifest:
        for model in self.registry.models:
            if model.version == place.version:
                return model.decoder.bundle.manifest
        if place == self.registry.base:
            return self.registry.base_manifest
        manifest = read_manifest(place.path)
        if manifest.version != place.version:
            raise BundleError(f"bundle {place.path}: version", manifest.version, place.version)
        return manifest

    def _stored(self, without: Collection[str]) -> Iterator[Manifest]:
        """Manifests of models that are not loaded, the oldest first."""
        base = self.registry.base
        if base.version not in without:
            yield self.registry.base_manifest
        stored = set(self.store.versions() if self.store is not None else ()) - {*without, base.version}
        found = []
        for version in stored:
            try:
                found.append(self._manifest(self._place(version)))
            except (BundleError, StorageError, SurroundingsError) as error:
                _log.warning("model %s is not listed: %s", version, error)
        yield from sorted(found, key=lambda manifest: manifest.created)

    def _entry(self, manifest: Manifest) -> ModelEntry:
        version, note = manifest.version, self._noted
        if version == self.registry.base.version:
            origin: Origin | None = Origin.GIVEN
        else:
            origin = note.origins.get(version) or (Origin.RECALIBRATED if "+r" in version else None)
        loaded = {model.version for model in self.registry.models}
        current = version == self.registry.current.version
        return ModelEntry(manifest, current, version in note.pinned, version in loaded, origin)

    @property
    def _room_bytes(self) -> int:
        return 2 * sum(map(len, self.registry.current.decoder.bundle.files.values()))


def _write_beside(path: Path, data: bytes) -> None:
    """Write a file that was not there before, and have it on the disk."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        synchronise(file.fileno())


class Upload:
    """A bundle that comes in pieces into a hidden file of the store. It is dropped unless `finish` returns.

    Args:
        models: take it in.
        store: where it is kept.
        size: bytes that are to come.
        digest: SHA-256 of them, or empty.
        caller: who sends them.
        signature: of them, or empty.
    """

    def __init__(
        self, models: Models, store: ModelStore, size: int, digest: bytes, caller: Caller, signature: bytes
    ) -> None:
        self._models, self._store, self._size, self._digest, self._caller = models, store, size, digest, caller
        self._signature = signature
        self._hash, self._come = hashlib.sha256(), 0
        self._file: IO[bytes] | None = None
        self._path: Path | None = None
        self._lock = threading.Lock()
        self._dropped = False

    def begin(self) -> None:
        """Open the file.

        Raises:
            StoreError: the store cannot be written, or has no room.
        """
        with self._at_work():
            self._models.check_store(self._size)
            descriptor, self._path = new_file(self._store.folder, UPLOAD.strip(".-"))
            self._file = os.fdopen(descriptor, "wb")

    def add(self, data: bytes) -> None:
        """Take the next piece.

        Raises:
            InvalidInputError: more than was announced.
            StoreError: it cannot be written.
        """
        with self._at_work():
            assert self._file is not None  # `begin` comes first
            self._come += len(data)
            if self._come > self._size:
                raise InvalidInputError("uploaded model", f"at least {self._come} bytes", f"{self._size}, as announced")
            self._hash.update(data)
            self._file.write(data)

    def finish(self) -> ModelEntry:
        """Check the bundle and take it in.

        Raises:
            InvalidInputError: less than was announced.
            BundleError: it is damaged, foreign, or there already; see `Models.take_in`.
            CallerLeft: the caller has gone.
        """
        with self._at_work():
            assert self._file is not None  # `begin` comes first
            assert self._path is not None
            if self._come != self._size:
                raise InvalidInputError("uploaded model", f"{self._come} bytes", f"{self._size}, as announced")
            if self._digest and self._hash.digest() != self._digest:
                found = self._hash.hexdigest()
                raise BundleError("uploaded model: SHA-256", found, f"{self._digest.hex()}, as announced")
            self._file.flush()
            synchronise(self._file.fileno())
            try:
                entry = self._models.take_in(self._path, self._check_here, self._signature)
            except Exception as error:
                self._models.record_upload("", self._caller.actor, error)
                raise
            self._models.record_upload(entry.manifest.version, self._caller.actor)
            return entry

    def drop(self) -> None:
        """Remove what has come, at once or when the piece at work is done; the bundle stays if it was taken in."""
        self._dropped = True
        if self._lock.acquire(blocking=False):
            try:
                if self._path is not None:
                    self._path.unlink(missing_ok=True)
                if self._file is not None:
                    self._file.close()
            except OSError as error:
                _log.warning("model store %s: an upload was dropped: %s", self._store.folder, error)
            finally:
                self._lock.release()

    def _check_here(self) -> None:
        self._caller.check()
        if self._dropped:
            raise CallerLeft

    @contextmanager
    def _at_work(self) -> Iterator[None]:
        """Work on the file; nobody removes it meanwhile."""
        try:
            with self._lock:
                self._check_here()
                yield
        except OSError as error:
            raise self._store.failed(error) from None
        finally:
            if self._dropped:  # while this was at work
                self.drop()
