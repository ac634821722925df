"""History of models: the order in which they came into service, and the facts of each bundle."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from pydantic import TypeAdapter, ValidationError

from lightpage.errors import BundleError
from lightpage.runtime.model.bundle.manifest import Version

HISTORY = 64
"""Steps of the history that are kept: beyond the bundles of a store there is nothing to go back to."""


class Origin(StrEnum):
    """Origin of a bundle."""

    GIVEN = "given"
    RECALIBRATED = "recalibrated"
    UPLOADED = "uploaded"


@dataclass(frozen=True)
class History:
    """Versions in the order in which they came into service, at least one; `cursor` is the index of the present one.

    A version that was put in service twice is there twice.

    Raises:
        ValueError: there is none at the cursor.
    """

    versions: tuple[Version, ...]
    cursor: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.cursor < len(self.versions):
            raise ValueError(f"bundle {self.cursor} of {len(self.versions)} in service")

    @property
    def current(self) -> str:
        """The version in service."""
        return self.versions[self.cursor]

    def stepped(self, by: int) -> History:
        """Return the history after a step of `by` places.

        Raises:
            BundleError: there is no model.
        """
        cursor = self.cursor + by
        if not 0 <= cursor < len(self.versions):
            name, way = ("rollback", "an earlier model to go back to") if by < 0 else ("roll-forward", "a later model")
            raise BundleError(name, f"only {self.current}", way)
        return History(self.versions, cursor)

    def followed_by(self, version: str) -> History:
        """Return the history with another model in service; those that were ahead are dropped."""
        versions = (*self.versions[: self.cursor + 1], version)[-HISTORY:]
        return History(versions, len(versions) - 1)

    def without(self, dropped: Collection[str]) -> History:
        """Return the history without some versions; the place in service stays."""
        kept = [i for i, version in enumerate(self.versions) if i == self.cursor or version not in dropped]
        return History(tuple(self.versions[i] for i in kept), kept.index(self.cursor))

    def distance(self, version: str) -> int:
        """Return the steps from the model in service to the nearest place of this version, which must be there."""
        return min(abs(i - self.cursor) for i, each in enumerate(self.versions) if each == version)


@dataclass(frozen=True)
class Known:
    """Facts of a bundle.

    Attributes:
        origin: source of the bundle, None where it is not known.
        key: fingerprint of the bundle key under which this service recalibrated it, empty for none; None of any other
            bundle.
        pinned: whether it is never deleted.
    """

    origin: Origin | None = None
    key: str | None = None
    pinned: bool = False


@dataclass(frozen=True)
class State:
    """All that is remembered of models: their history, and what is known of bundles, by version."""

    history: History
    bundles: Mapping[str, Known] = field(default_factory=dict)

    def known(self, version: str) -> Known:
        """Return what is known of a bundle; one that nobody has noted is a recalibration if its version says so."""
        return self.bundles.get(version) or Known(Origin.RECALIBRATED if "+r" in version else None)

    def among(self, versions: Collection[str]) -> State:
        """Return the state without what is known of bundles that are none of these, and not pinned."""
        kept = {name: known for name, known in self.bundles.items() if known.pinned or name in versions}
        return replace(self, bundles=kept)

    def noting(self, version: str, **known: Any) -> State:
        """Return the state with fields of `Known` changed."""
        return replace(self, bundles={**self.bundles, version: replace(self.known(version), **known)})

    def to_json(self) -> str:
        """Return itself as JSON, which `state_of` reads."""
        return _STATE.dump_json(self).decode()


_STATE = TypeAdapter(State)


def state_of(remembered: str | Mapping[str, Any]) -> State:
    """Return what JSON says, or an object that was read from JSON.

    Raises:
        ValueError: it is no state, or contradicts itself.
    """
    try:
        return _STATE.validate_json(remembered) if isinstance(remembered, str) else _STATE.validate_python(remembered)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
