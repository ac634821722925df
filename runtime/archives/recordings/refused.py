"""Pages that could not be decoded: they are kept out of the figures, told, and end a command with an error."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

from lightpage.errors import Cause, InvalidInputError, LightpageError, LostPageError, MissingResultsError

_TOLD = 5
"""Pages named in the error; the JSON file has all of them."""

WORTH_NOTHING = (
    "by what the bundle believes, these pages carry nothing: the device may have drifted far (lightpage recalibrate), "
    "be another one, have its cameras the other way round, or its symbols another number of levels or other pages"
)
"""Said of pages on which what is right in a decoder's claims adds up to nothing."""


@dataclass(frozen=True)
class RefusedPage:
    """A page that was not given out.

    Attributes:
        page: its number, None where only the service knows it.
        reason: why, for people.
        unconfirmed: whether it was decoded, and its pilots did not bear out the result.
        loss: why, for programs: the name of a `lightpage.errors.Reason`; None of a page that was not decoded.
        recalibration_due: whether it shows that the device has changed since it was calibrated.
        cause: what the reason is about; of storage, nothing is found about the page.
    """

    page: int | None
    reason: str
    unconfirmed: bool = False
    loss: str | None = None
    recalibration_due: bool = False
    cause: Cause = Cause.CONTENT

    @classmethod
    def of(cls, page: int | None, error: LightpageError) -> Self:
        """The page that an error is about."""
        if not isinstance(error, LostPageError):
            return cls(page, str(error), cause=error.cause)
        return cls(page, str(error), True, error.reason.value, error.recalibration_due, error.cause)


def unconfirmed(refused: Sequence[RefusedPage]) -> int:
    """Return how many of the pages were decoded and not confirmed."""
    return sum(page.unconfirmed for page in refused)


def refused_json(refused: Sequence[RefusedPage]) -> dict[str, Any]:
    """The pages under the names that other programs read."""
    return {"pages_unconfirmed": unconfirmed(refused), "refused_pages": [asdict(page) for page in refused]}


def refusal(subject: str, refused: Sequence[RefusedPage], pages: int) -> InvalidInputError | MissingResultsError:
    """The error that a command ends with when `refused` of its `pages` pages of `subject` could not be decoded.

    Returns:
        A `MissingResultsError` where storage did not give some of them: the same command may read these.
    """
    told = "; ".join(f"page {'unknown' if r.page is None else r.page}: {r.reason}" for r in refused[:_TOLD])
    more = f"; and {len(refused) - _TOLD} more" if len(refused) > _TOLD else ""
    got = f"{len(refused)} of {pages} pages that were refused ({told}{more})"
    if any(page.cause is Cause.STORAGE for page in refused):
        return MissingResultsError(subject, got, "storage that gives every page; the same command tries again")
    return InvalidInputError(subject, got, "pages that can be decoded")
