"""Pages that could not be decoded: they are kept out of the figures, told, and end a command with an error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from optics.errors import InvalidInputError

_TOLD = 5
"""Pages named in the error; the JSON file has all of them."""

WORTH_NOTHING = (
    "by what the bundle believes, these pages carry nothing: the device may have drifted far (lightpage recalibrate), "
    "be another one, have its cameras the other way round, or its symbols another number of levels or other pages"
)
"""Said of pages on which what is right in a decoder's claims adds up to nothing."""


@dataclass(frozen=True)
class RefusedPage:
    """A page that could not be decoded, and why; its number is None where only the service knows it."""

    page: int | None
    reason: str


def refusal(thing: str, refused: Sequence[RefusedPage], pages: int) -> InvalidInputError:
    """The error that a command ends with when `refused` of its `pages` pages of `thing` could not be decoded."""
    told = "; ".join(f"page {'unknown' if r.page is None else r.page}: {r.reason}" for r in refused[:_TOLD])
    more = f"; and {len(refused) - _TOLD} more" if len(refused) > _TOLD else ""
    return InvalidInputError(
        thing, f"{len(refused)} of {pages} pages that were refused ({told}{more})", "pages that can be decoded"
    )
