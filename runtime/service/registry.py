"""The models' life: which one decodes now, how the next one takes over, and the way back."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from lightpage.errors import BundleError, RecalibrationRefusedError
from runtime.decoding.decoder import Decoder
from runtime.decoding.tracking import NoTracker, Tracker
from runtime.service.caller import Caller
from runtime.service.sessions import Sessions

KEPT_MODELS = 4
"""Models held loaded, the current one included: enough to step back over a bad day, and a bound on the memory."""

TrackerFactory = Callable[[Decoder], Tracker]
ModelNote = Callable[["Model"], None]
"""Writes down the model that is about to be in service; raises where it cannot, and then nothing changes."""


def no_note(model: Model) -> None:
    """Writes nothing down."""


def no_tracker(decoder: Decoder) -> Tracker:
    """A tracker that follows nothing."""
    return NoTracker(decoder)


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
    def sessions(self) -> Sessions:
        """Follow the pages that callers send."""
        return Sessions(self.tracker.anew)

    def tracker_for(self, caller: Caller) -> Tracker:
        """What follows a caller's pages."""
        if caller.stateless:
            return self.tracker.anew()
        return self.sessions.tracker(caller.session) if caller.session else self.tracker

    @property
    def version(self) -> str:
        """The bundle's version."""
        return self.decoder.version


class ModelRegistry:
    """Holds the models. A request takes `current` once and keeps it: a swap never pulls a model from under it.

    Args:
        first: the decoder to start with.
        make_tracker: makes the tracker of each model.
        kept: models held at most.
    """

    def __init__(self, first: Decoder, make_tracker: TrackerFactory = no_tracker, kept: int = KEPT_MODELS) -> None:
        self._make_tracker, self._kept = make_tracker, kept
        self._changing = threading.Lock()
        """Held from the checks of a change to its end, its note included; taken before the lock below."""
        self._lock = threading.Lock()
        """Guards the list; never held while a model is loaded, noted or decodes."""
        self._models = [Model(first, make_tracker(first))]

    @property
    def current(self) -> Model:
        """The model that new requests use."""
        with self._lock:
            return self._models[-1]

    @property
    def models(self) -> tuple[Model, ...]:
        """All models held, the oldest first, the current one last."""
        with self._lock:
            return tuple(self._models)

    def swap(self, decoder: Decoder, expected: Model | None = None, note: ModelNote = no_note) -> Model:
        """Put a loaded decoder in service and return its model; the previous one is kept for `rollback`.

        Args:
            decoder: loaded and checked.
            expected: if given, the model that must still be current: a result derived from another is out of date.
            note: called with the new model before it is in service; what it raises leaves the old one there.

        Raises:
            BundleError: the decoder is for another device, its version is held already, or it cannot be tracked.
            CalibrationError: its tracker needs a calibration that the bundle does not hold.
            RecalibrationRefusedError: `expected` is no longer current.
        """
        model = Model(decoder, self._make_tracker(decoder))
        with self._changing:
            held = self.models
            current = held[-1]
            if expected is not None and current is not expected:
                raise RecalibrationRefusedError(
                    "model in service", f"{current.version} by now", f"{expected.version}, which was recalibrated"
                )
            self._check_replaces(decoder, current.decoder)
            if any(other.version == decoder.version for other in held):
                raise BundleError(f"{decoder.bundle.subject}: version", decoder.version, "a version not held already")
            note(model)
            with self._lock:
                self._models = [*held, model][-self._kept :]
        return model

    def rollback(self, note: ModelNote = no_note) -> tuple[Model, Model]:
        """Put the model before the current one back in service; returns (now current, dropped).

        Args:
            note: called with the earlier model before it is in service; what it raises leaves the later one there.

        Raises:
            BundleError: there is no earlier model.
        """
        with self._changing:
            held = self.models
            if len(held) < 2:
                raise BundleError("rollback", f"only {held[-1].version}", "an earlier model to go back to")
            note(held[-2])
            with self._lock:
                self._models = list(held[:-1])
            return held[-2], held[-1]

    @staticmethod
    def _check_replaces(new: Decoder, old: Decoder) -> None:
        """A caller must not see shapes change between two calls."""
        shapes = [
            (d.bundle.profile.frame_shape, d.bundle.profile.page_shape, d.bundle.manifest.frame_dtype)
            for d in (new, old)
        ]
        if shapes[0] != shapes[1]:
            raise BundleError(f"{new.bundle.subject}: frames and page", shapes[0], f"{shapes[1]}, as in service")
