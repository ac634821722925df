"""The models' life: which one decodes now, how the next one takes over, and the way back and forward again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from lightpage.errors import BundleError, CalibrationError, ModelExistsError, OtherModelError, RecalibrationRefusedError
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import Manifest
from lightpage.runtime.model.bundle.signature import BundleKey
from lightpage.runtime.model.bundle.signature_file import read_signature, signature_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker, Tracker
from lightpage.runtime.service.caller import Caller, Sessions

KEPT_MODELS = 4
"""Models held loaded, the current one included: enough to step back over a bad day, and a bound on the memory."""

HISTORY = 64
"""Steps of the history that are kept: beyond the bundles of a store there is nothing to go back to."""

TrackerFactory = Callable[[Decoder], Tracker]


@dataclass(frozen=True)
class Model:
    """A loaded decoder with the trackers that belong to it.

    Attributes:
        decoder: of its bundle.
        tracker: follows the pages of the service's own device.
    """

    decoder: Decoder
    tracker: Tracker

    @cached_property
    def sessions(self) -> Sessions[Tracker]:
        """Follow the pages that callers send."""
        return Sessions(lambda _: self.tracker.anew())

    def tracker_for(self, caller: Caller) -> Tracker:
        """What follows a caller's pages."""
        if caller.stateless:
            return self.tracker.anew()
        return self.sessions.of(caller.session) if caller.session else self.tracker

    @property
    def version(self) -> str:
        """The bundle's version."""
        return self.decoder.version


@dataclass(frozen=True)
class Place:
    """Where a model can be loaded from: its version and the path of its bundle."""

    version: str
    path: Path


@dataclass(frozen=True)
class History:
    """Models in the order in which they came into service, at least one.

    Attributes:
        places: of them; one that was put in service twice is there twice.
        cursor: index of the one in service.
    """

    places: tuple[Place, ...]
    cursor: int = 0

    @property
    def current(self) -> Place:
        """The one in service."""
        return self.places[self.cursor]

    def stepped(self, by: int) -> History:
        """The history after a step of `by` places.

        Raises:
            BundleError: there is no model.
        """
        cursor = self.cursor + by
        if not 0 <= cursor < len(self.places):
            name, way = ("rollback", "an earlier model to go back to") if by < 0 else ("roll-forward", "a later model")
            raise BundleError(name, f"only {self.current.version}", way)
        return History(self.places, cursor)

    def followed_by(self, place: Place) -> History:
        """The history with another model in service; those that were ahead are dropped."""
        places = (*self.places[: self.cursor + 1], place)[-HISTORY:]
        return History(places, len(places) - 1)

    def without(self, dropped: Collection[Place]) -> History:
        """The history without some places, the current one of which stays."""
        kept = [i for i, place in enumerate(self.places) if i == self.cursor or place not in dropped]
        return History(tuple(self.places[i] for i in kept), kept.index(self.cursor))

    def distance(self, version: str) -> int:
        """Steps from the model in service to the nearest place of this version, which must be there."""
        return min(abs(i - self.cursor) for i, place in enumerate(self.places) if place.version == version)


ModelNote = Callable[[Model, History], None]
"""Writes down the model that is about to be in service; raises where it cannot, and then nothing changes."""


def no_note(model: Model, history: History) -> None:
    """Writes nothing down."""


class ModelRegistry:
    """Holds the models. A request takes `current` once and keeps it: a swap never pulls a model from under it.

    Args:
        first: the decoder to start with.
        make_tracker: makes the tracker of each model.
        kept: models held loaded at most; others of the history are loaded again when they are gone to.
        key: that bundles must be signed with which come from elsewhere; None for none.

    Attributes:
        made_under: says of a version which fingerprint the bundle key had when this service recalibrated it, empty for
            no key, and None where it did not. Under the present key it needs no signature.
    """

    def __init__(
        self,
        first: Decoder,
        make_tracker: TrackerFactory = NoTracker,
        kept: int = KEPT_MODELS,
        key: BundleKey | None = None,
    ) -> None:
        self._make_tracker, self._kept, self._key = make_tracker, kept, key
        self.made_under: Callable[[str], str | None] = lambda version: None
        self._changing = threading.Lock()
        """Held from the checks of a change to its end, its note included; taken before the lock below."""
        self._lock = threading.Lock()
        """Guards the two below; never held while a model is loaded, noted or decodes."""
        self.base = Place(first.version, first.bundle.path)
        self.base_manifest: Manifest = first.bundle.manifest
        self._history = History((self.base,))
        self._loaded = {first.version: Model(first, make_tracker(first))}

    @property
    def current(self) -> Model:
        """The model that new requests use."""
        with self._lock:
            return self._loaded[self._history.current.version]

    def expect(self, version: str) -> Model:
        """The model in service, which must be of this version; empty stands for any.

        Raises:
            OtherModelError: it is of another one.
        """
        current = self.current
        if version and current.version != version:
            raise OtherModelError("model in service", current.version, version)
        return current

    @property
    def history(self) -> History:
        """Models in the order in which they came into service."""
        with self._lock:
            return self._history

    @property
    def models(self) -> tuple[Model, ...]:
        """All models held loaded, in the order of the history."""
        with self._lock:
            order = dict.fromkeys(place.version for place in self._history.places)
            return tuple(self._loaded[version] for version in order if version in self._loaded)

    def swap(self, decoder: Decoder, expected: Model | None = None, note: ModelNote = no_note) -> Model:
        """Put a loaded decoder in service and return its model; the previous one is kept to step back to.

        Args:
            decoder: loaded and checked.
            expected: if given, the model that must still be current: a result derived from another is out of date.
            note: called with the new model before it is in service; what it raises leaves the old one there.

        Raises:
            BundleError: the decoder is for another device, its version is in the history, or it cannot be tracked.
            CalibrationError: its tracker needs a calibration that the bundle does not hold.
            RecalibrationRefusedError: `expected` is no longer current.
        """
        model = Model(decoder, self._make_tracker(decoder))
        with self._changing:
            current, history = self.current, self.history
            if expected is not None and current is not expected:
                raise RecalibrationRefusedError(
                    "model in service", f"{current.version} by now", f"{expected.version}, which was recalibrated"
                )
            self._check_replaces(decoder, current.decoder)
            if any(place.version == decoder.version for place in history.places):
                subject = f"{decoder.bundle.subject}: version"
                raise ModelExistsError(subject, decoder.version, "a version not held already")
            self._change(model, history.followed_by(Place(decoder.version, decoder.bundle.path)), note)
        return model

    def step(self, by: int, expected: str = "", note: ModelNote = no_note) -> tuple[Model, Model]:
        """Put an earlier (`by` = -1) or later (1) model of the history in service; returns (now current, before).

        Args:
            by: places.
            expected: version that must be in service; empty for any.
            note: as for `swap`.

        Raises:
            BundleError: there is none, or it cannot be loaded any more.
            OtherModelError: another version is in service.
        """
        with self._changing:
            before = self.expect(expected)
            history = self.history.stepped(by)
            model = self._model(history.current)
            self._change(model, history, note)
            return model, before

    def go_to(self, place: Place, expected: str = "", note: ModelNote = no_note) -> tuple[Model, Model]:
        """Put a model in service that need not be loaded; returns (now current, before).

        The current one stays where it is in service already.

        Args:
            place: where the model is.
            expected: version that must be in service; empty for any.
            note: as for `swap`.

        Raises:
            BundleError: it cannot be loaded, or is for another device.
            OtherModelError: another version is in service.
        """
        with self._changing:
            before = self.expect(expected)
            if place.version == before.version:
                return before, before
            model = self._model(place)
            self._change(model, self.history.followed_by(place), note)
            return model, before

    def resume(self, history: History) -> None:
        """Take over a history with its model in service, as after a restart.

        Raises:
            BundleError: that model cannot be loaded, or is for another device.
        """
        with self._changing:
            self._change(self._model(history.current), history, no_note)

    def forget(self, paths: Collection[Path], note: Callable[[History], None]) -> None:
        """Drop places of the history whose bundles are about to be deleted, and that are not loaded.

        `note` is called before, if anything is dropped; what it raises leaves the history as it is.
        """
        with self._changing:
            loaded, history = {model.version for model in self.models}, self.history
            dropped = [place for place in history.places if place.path in paths and place.version not in loaded]
            if dropped:
                history = history.without(dropped)
                note(history)
                with self._lock:
                    self._history = history

    @property
    def wants_signatures(self) -> bool:
        """Whether bundles that come from elsewhere must be signed."""
        return self._key is not None

    @property
    def key_fingerprint(self) -> str:
        """Of the key that they must be signed with; empty for none."""
        return "" if self._key is None else self._key.fingerprint

    def opened(self, path: Path, signature: bytes = b"") -> Decoder:
        """The decoder of a bundle that comes from elsewhere.

        Args:
            path: of it.
            signature: of it; empty for that in the file beside it.

        Raises:
            BundleError: it is damaged, or lacks the signature that it needs.
        """
        return self.current.decoder.of_another(Bundle.open(path, key=self._key, signature=signature))

    def _model(self, place: Place) -> Model:
        """A model, loaded if it is not."""
        with self._lock:
            held = self._loaded.get(place.version)
        if held is not None:
            return held
        made_under = None if place == self.base else self.made_under(place.version)
        if made_under == self.key_fingerprint:
            decoder = self.current.decoder.of_another(Bundle.open(place.path))
        elif made_under is not None and self.wants_signatures and not read_signature(place.path):
            got = f"none, and it was recalibrated under {'another bundle key' if made_under else 'no bundle key'}"
            expected = f"the file {signature_path(place.path).name} beside it, or a recalibration of a signed bundle"
            raise BundleError(f"bundle {place.path}: signature", got, expected)
        else:
            decoder = self.opened(place.path)
        if decoder.version != place.version:
            raise BundleError(f"{decoder.bundle.subject}: version", decoder.version, place.version)
        return self.tracked(decoder)

    def tracked(self, decoder: Decoder) -> Model:
        """A model that could be put in service.

        Raises:
            BundleError: the decoder is for another device, or cannot be tracked.
        """
        self._check_replaces(decoder, self.current.decoder)
        try:
            return Model(decoder, self._make_tracker(decoder))
        except CalibrationError as error:
            raise BundleError(error.subject, error.got, error.expected) from None

    def _change(self, model: Model, history: History, note: ModelNote) -> None:
        note(model, history)
        with self._lock:
            loaded = self._loaded | {model.version: model}
            named = {place.version for place in history.places}
            nearest = sorted((v for v in loaded if v in named), key=history.distance)
            self._history = history
            self._loaded = {version: loaded[version] for version in nearest[: self._kept]}

    @staticmethod
    def _check_replaces(new: Decoder, old: Decoder) -> None:
        """A caller must not see shapes change between two calls."""
        shapes = [
            (d.bundle.profile.frame_shape, d.bundle.profile.page_shape, d.bundle.manifest.frame_dtype)
            for d in (new, old)
        ]
        if shapes[0] != shapes[1]:
            raise BundleError(f"{new.bundle.subject}: frames and page", shapes[0], f"{shapes[1]}, as in service")
        depth, current = (d.bundle.manifest.camera_bit_depth for d in (new, old))
        if depth != current:
            raise BundleError(f"{new.bundle.subject}: camera", f"{depth} bits", f"{current} bits, as in service")
