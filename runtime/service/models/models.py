"""The models of a service, those that are loaded and those of its store: which decodes, and how that is changed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

from lightpage.errors import (
    BundleError,
    LightpageError,
    ModelExistsError,
    OtherModelError,
    RecalibrationRefusedError,
    StorageError,
    StoreError,
    SurroundingsError,
)
from lightpage.runtime.model.bundle.bundle import read_manifest
from lightpage.runtime.model.bundle.manifest import Manifest, check_version
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import NOBODY, Actor
from lightpage.runtime.service.models.audit import AuditLog, Entry
from lightpage.runtime.service.models.database import Write
from lightpage.runtime.service.models.history import History, Origin, State
from lightpage.runtime.service.models.loader import Loader, Model
from lightpage.runtime.service.models.store import Store
from lightpage.runtime.service.models.store_health import Reason

_log = logging.getLogger(__name__)

KEPT_MODELS = 4
"""Models held loaded, the current one included: enough to step back over a bad day, and a bound on the memory."""

Change = Callable[[State], tuple[State, Model | None]]


@dataclass(frozen=True)
class ModelEntry:
    """Facts of a model.

    Attributes:
        manifest: manifest of its bundle.
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


@dataclass(frozen=True)
class Snapshot:
    """The models at one moment.

    Attributes:
        state: what is remembered.
        loaded: those that are loaded, by version.
    """

    state: State
    loaded: Mapping[str, Model]

    @property
    def current(self) -> Model:
        """The model in service."""
        return self.loaded[self.state.history.current]

    def changed(self, state: State, model: Model, kept: int) -> Snapshot:
        """Return the models with another state and its model in service; of all, the nearest `kept` stay loaded."""
        loaded, history = {**self.loaded, model.version: model}, state.history
        nearest = sorted((version for version in loaded if version in history.versions), key=history.distance)
        return Snapshot(state, {version: loaded[version] for version in nearest[:kept]})


class Models:
    """Owns the models. Readers take what is there and wait for nobody; changes, from many threads, follow each other.

    A request takes `current` once and keeps it: no change pulls a model from under it. A change is on the disk, with
    its entry of the record, before it takes effect; where it cannot be written, nothing changes. The service goes on
    with what the store remembers, as far as it can be used; what cannot is logged and is the store's trouble.

    Args:
        first: the decoder that the operator gave.
        store: where models are kept; by default they end with the service.
        loader: loads the others.
        audit: audit of the store; keeps every change, and those that failed.
        kept: models held loaded at most; others of the history are loaded again when they are gone to.

    Attributes:
        base: manifest of the first decoder.
        now: the models at this moment.
        in_service: is told which model has come into service.
    """

    def __init__(
        self,
        first: Decoder,
        store: Store | None = None,
        loader: Loader | None = None,
        audit: AuditLog | None = None,
        kept: int = KEPT_MODELS,
    ) -> None:
        self.store, self.loader = store or Store(None, first.bundle), loader or Loader()
        self._audit, self._kept = audit or AuditLog(self.store), kept
        self.base, self._base_path = first.bundle.manifest, first.bundle.path
        self.in_service: Callable[[Model], None] = lambda model: None
        found = self.store.contents
        begun = State(History((first.version,)), found.state.bundles)
        self.now = Snapshot(begun, {})
        self._serve(begun, self.loader.tracked(first, first))
        self._resume(found.state)

    # ---- what is there ---------------------------------------------------------------------------------------------

    @property
    def current(self) -> Model:
        """The model that new requests use."""
        return self.now.current

    @property
    def loaded(self) -> tuple[Model, ...]:
        """All models held loaded, in the order of the history."""
        now = self.now
        order = dict.fromkeys(now.state.history.versions)
        return tuple(now.loaded[version] for version in order if version in now.loaded)

    def expect(self, version: str) -> Model:
        """Return the model in service, which must be of this version; empty stands for any.

        Raises:
            OtherModelError: it is of another one.
        """
        current = self.current
        if version and current.version != version:
            raise OtherModelError("model in service", current.version, version)
        return current

    def entry(self, manifest: Manifest) -> ModelEntry:
        """Return what is known of the model of a manifest."""
        now, version = self.now, manifest.version
        known = now.state.known(version)
        origin = Origin.GIVEN if version == self.base.version else known.origin
        return ModelEntry(manifest, version == now.state.history.current, known.pinned, version in now.loaded, origin)

    def entries(self, stored: bool = False) -> list[ModelEntry]:
        """Return the models that are loaded, the oldest first; before them the others of the store, if `stored`.

        Bundles of the store that cannot be read are left out.
        """
        loaded, others = [model.decoder.bundle.manifest for model in self.loaded], list[Manifest]()
        versions = {self.base.version, *self.store.folder.versions()} if stored else set()
        for version in versions.difference(manifest.version for manifest in loaded):
            try:
                others.append(self._manifest(version))
            except (BundleError, StorageError, SurroundingsError) as error:
                _log.warning("model %s is not listed: %s", version, error)
        others.sort(key=lambda manifest: (manifest.version != self.base.version, manifest.created))
        return [self.entry(manifest) for manifest in (*others, *loaded)]

    def versions(self) -> list[str]:
        """Versions that were in service, or are in the store: none of them is given again."""
        return [self.base.version, *self.now.state.history.versions, *self.store.folder.versions()]

    # ---- changes ---------------------------------------------------------------------------------------------------

    def adopt(self, decoder: Decoder, expected: Model | None = None, actor: Actor = NOBODY, *more: Write) -> Model:
        """Put a recalibrated decoder in service, and return its model; the one before is kept to step back to.

        Args:
            decoder: loaded and checked.
            expected: if given, the model that must still be in service: a result derived from another is out of date.
            actor: who does it, for the record.
            more: is written in the same transaction.

        Raises:
            BundleError: it is for another device, its version is known, or it cannot be tracked or remembered.
            RecalibrationRefusedError: `expected` is no longer in service.
        """
        version = decoder.version

        def adopted(state: State) -> tuple[State, Model]:
            current = self.current
            if expected is not None and current is not expected:
                wanted = f"{expected.version}, which was recalibrated"
                raise RecalibrationRefusedError("model in service", f"{current.version} by now", wanted)
            model = self.loader.tracked(decoder, current.decoder)
            if version in state.history.versions:
                raise ModelExistsError(f"{decoder.bundle.subject}: version", version, "a version not held already")
            noted = state.among(self.versions())
            noted = noted.noting(version, origin=Origin.RECALIBRATED, key=self.loader.fingerprint)
            return replace(noted, history=state.history.followed_by(version)), model

        return self.change("recalibrate", actor, adopted, version, *more)[0]

    def rollback(self, expected: str = "", actor: Actor = NOBODY) -> tuple[Model, Model]:
        """Go back to the model before; returns (now current, before).

        Args:
            expected: version that must be in service; empty for any.
            actor: who does it, for the record.

        Raises:
            BundleError: there is none, it is damaged or foreign, or it cannot be remembered; then nothing changes.
            OtherModelError: another version is in service.
        """
        return self._moved("rollback", lambda history: history.stepped(-1), expected, actor)

    def roll_forward(self, expected: str = "", actor: Actor = NOBODY) -> tuple[Model, Model]:
        """Go to the later model again: the opposite of `rollback`, which raises the same."""
        return self._moved("roll forward", lambda history: history.stepped(1), expected, actor)

    def activate(self, version: str, expected: str = "", actor: Actor = NOBODY) -> tuple[Model, Model]:
        """Put a model in service that need not be loaded; as `rollback`."""

        def followed(history: History) -> History:
            self._manifest(version)
            return history if version == history.current else history.followed_by(version)

        return self._moved("activate", followed, expected, actor, version)

    def pin(self, version: str, pinned: bool, actor: Actor = NOBODY) -> ModelEntry:
        """Pin a model, or let go of it.

        Raises:
            BundleError: there is none, or it cannot be remembered.
        """
        manifest, what = self._manifest(version), "pin" if pinned else "unpin"
        self.change(what, actor, lambda state: (state.noting(version, pinned=pinned), None), version)
        return self.entry(manifest)

    def prune(self, *more: str) -> None:
        """Delete the oldest bundles of the store, but none that is loaded, pinned, or one of `more`."""
        with self.store.changing:
            now, folder = self.now, self.store.folder
            if self.store.is_damaged:  # what is still there may be needed
                return
            held = {*now.loaded, *more, *(version for version, known in now.state.bundles.items() if known.pinned)}
            try:
                own = folder.newest_first(lambda version: now.state.known(version).origin is not None)
                dropped = [version for version in own[self.store.kept :] if version not in held]
                state = replace(now.state, history=now.state.history.without(dropped))
                if state != now.state:
                    self.store.save(state)
                    self.now = replace(now, state=state)
                for version in dropped:
                    folder.delete(version)
                    _log.info("%s: dropped %s", folder.subject, version)
            except (OSError, StoreError) as error:  # the models serve all the same
                _log.warning("%s: old bundles stay: %s", folder.subject, error)

    @contextmanager
    def recorded(self, what: str, actor: Actor, version: str = "") -> Iterator[None]:
        """Write down where a change fails; `version` is what it is about, if that is known."""
        try:
            yield
        except Exception as error:
            with self.store.changing:
                self._audit.failed(Entry(what, actor, self.current.version, version, error))
            raise

    def change(self, what: str, actor: Actor, make: Change, version: str = "", *more: Write) -> tuple[Model, Model]:
        """Make a change: it is written with its entry of the record in one transaction, and then takes effect.

        Args:
            what: it is called in the record.
            actor: who makes it.
            make: returns the state after it, and the model that comes into service, None where the present one stays.
            version: version that it is about; empty for that in service after it.
            more: is written too.

        Returns:
            The model in service now, and the one before.

        Raises:
            StoreError: it cannot be written; then nothing changes.
            Exception: what `make` raises.
        """
        with self.store.changing, self.recorded(what, actor, version):
            before = self.current
            state, model = make(self.now.state)
            entry = Entry(what, actor, before.version, version or state.history.current)
            self.store.save(state, partial(self._audit.write, entry), *more, settles=model is not None)
            if model is None:
                self.now = replace(self.now, state=state)
            else:
                self._serve(state, model)
                try:
                    self.in_service(model)
                except Exception:  # the change is made, and whoever asked for it must not hear otherwise
                    _log.exception("model %s is in service, and not everybody knows", model.version)
            self._audit.done(entry)
            return self.current, before

    def _moved(
        self, what: str, move: Callable[[History], History], expected: str, actor: Actor, version: str = ""
    ) -> tuple[Model, Model]:
        def moved(state: State) -> tuple[State, Model | None]:
            self.expect(expected)
            history = move(state.history)
            return replace(state, history=history), None if history is state.history else self._model(history.current)

        return self.change(what, actor, moved, version)

    def _serve(self, state: State, model: Model) -> None:
        self.now = self.now.changed(state, model, self._kept)
        self.store.room_bytes = 2 * sum(map(len, model.decoder.bundle.files.values()))

    def _resume(self, state: State) -> None:
        """Go on with a state as far as it can be used: with the newest model before that in service that can."""
        folder, history, base = self.store.folder, state.history, self.base.version
        there = {base, *folder.versions()}
        gone = [version for version in dict.fromkeys(history.versions) if version not in there]
        history = history.without(gone)
        errors: list[LightpageError] = [
            BundleError(f"bundle {folder.bundle(version)}", "nothing", "a bundle that was in service")
            for version in gone
            if version != history.current  # an attempt to load it says so
        ]
        for cursor in range(history.cursor, -1, -1):
            here = History(history.versions, cursor)
            try:
                self._serve(replace(state, history=here), self._model(here.current))
                break
            except (BundleError, StorageError, SurroundingsError) as error:
                errors.append(error)
        current = self.current.version
        for lost in errors:
            self.store.damaged(Reason.BUNDLE, lost)
            _log.warning("serving %s%s: %s", current, " as it was given" if current == base else "", lost)

    def _model(self, version: str) -> Model:
        """A model of the history, loaded if it is not."""
        now = self.now
        if version in now.loaded:
            return now.loaded[version]
        path = self._base_path if version == self.base.version else self.store.folder.bundle(version)
        return self.loader.load(version, path, now.current.decoder, now.state.known(version).key)

    def _manifest(self, version: str) -> Manifest:
        """The manifest of a model that is loaded, was in service, or is in the store."""
        check_version(version, "model")
        now = self.now
        if version in now.loaded:
            return now.loaded[version].decoder.bundle.manifest
        if version == self.base.version:
            return self.base
        path = self.store.folder.bundle(version)
        if version not in now.state.history.versions and not path.is_file():
            raise BundleError("model", f"version {version}", "that of a model that the service has")
        manifest = read_manifest(path)
        if manifest.version != version:
            raise BundleError(f"bundle {path}: version", manifest.version, version)
        return manifest
