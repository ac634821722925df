"""A model: a decoder with the trackers that belong to it, and how it is loaded and checked."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from lightpage.errors import BundleError, CalibrationError
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.signature import BundleKey
from lightpage.runtime.model.bundle.signature_file import read_signature, signature_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker, Tracker
from lightpage.runtime.service.caller import Caller, Sessions

TrackerFactory = Callable[[Decoder], Tracker]


@dataclass(frozen=True)
class Model:
    """A loaded decoder with the tracker that follows the pages of the service's own device."""

    decoder: Decoder
    tracker: Tracker

    @cached_property
    def sessions(self) -> Sessions[Tracker]:
        """Follow the pages that callers send."""
        return Sessions(lambda _: self.tracker.anew())

    def tracker_for(self, caller: Caller) -> Tracker:
        """Return what follows a caller's pages."""
        if caller.stateless:
            return self.tracker.anew()
        return self.sessions.of(caller.session) if caller.session else self.tracker

    @property
    def version(self) -> str:
        """The bundle's version."""
        return self.decoder.version


class Loader:
    """Loads models that may follow one that is in service.

    Args:
        make_tracker: makes the tracker of each model.
        key: key that bundles from elsewhere must be signed with; None for none.

    Attributes:
        wants_signatures: whether there is such a key.
        fingerprint: fingerprint of the key; empty for none.
    """

    def __init__(self, make_tracker: TrackerFactory = NoTracker, key: BundleKey | None = None) -> None:
        self._make_tracker, self._key = make_tracker, key
        self.wants_signatures, self.fingerprint = key is not None, "" if key is None else key.fingerprint

    def opened(self, path: Path, current: Decoder, signature: bytes = b"") -> Decoder:
        """Return the decoder of a bundle that comes from elsewhere, to run as the `current` one does.

        Without a signature, that in the file beside it counts.

        Raises:
            BundleError: it is damaged, or lacks the signature that it needs.
        """
        return current.of_another(Bundle.open(path, key=self._key, signature=signature))

    def load(self, version: str, path: Path, current: Decoder, made_under: str | None) -> Model:
        """Return the model of a bundle.

        Args:
            version: version that it must have.
            path: path of the bundle.
            current: the decoder in service.
            made_under: fingerprint of the key under which this service recalibrated it, empty for no key, None where
                it did not. Under the present key it needs no signature.

        Raises:
            BundleError: it is damaged or foreign, or lacks the signature that it needs.
        """
        if made_under == self.fingerprint:
            decoder = current.of_another(Bundle.open(path))
        elif made_under is not None and self.wants_signatures and not read_signature(path):
            got = f"none, and it was recalibrated under {'another bundle key' if made_under else 'no bundle key'}"
            expected = f"the file {signature_path(path).name} beside it, or a recalibration of a signed bundle"
            raise BundleError(f"bundle {path}: signature", got, expected)
        else:
            decoder = self.opened(path, current)
        if decoder.version != version:
            raise BundleError(f"{decoder.bundle.subject}: version", decoder.version, version)
        return self.tracked(decoder, current)

    def tracked(self, decoder: Decoder, current: Decoder) -> Model:
        """Return a model that could be put in service: no caller may see shapes change between two calls.

        Raises:
            BundleError: the decoder is for another device than the `current` one, or cannot be tracked.
        """
        new, old = (
            (d.bundle.profile.frame_shape, d.bundle.profile.page_shape, d.bundle.manifest.frame_dtype)
            for d in (decoder, current)
        )
        if new != old:
            raise BundleError(f"{decoder.bundle.subject}: frames and page", new, f"{old}, as in service")
        depth, present = (d.bundle.manifest.camera_bit_depth for d in (decoder, current))
        if depth != present:
            raise BundleError(f"{decoder.bundle.subject}: camera", f"{depth} bits", f"{present} bits, as in service")
        try:
            return Model(decoder, self._make_tracker(decoder))
        except CalibrationError as error:
            raise BundleError(error.subject, error.got, error.expected) from None
