"""A report's contents from the JSON of `lightpage recover`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Self

from pydantic import Field, model_validator

from lightpage.codec.code import Code
from lightpage.codec.page_bytes import LOSSES, Loss
from lightpage.codec.volume import Volume
from lightpage.codec.volume_file import ranges
from lightpage.errors import InvalidInputError
from lightpage.report.json_file import Bits, JsonFile, Part, Seconds, Share

Count = Annotated[int, Field(ge=0, le=1 << 53)]
"""A number of things, or the number of a thing; a float knows all of these."""
Margin = Annotated[float, Field(ge=-1000, le=8)]
"""Bits a symbol, of which at most eight are coded; it can be as negative as confidences mislead."""

UNDECODED = frozenset({Loss.OPTICS, Loss.CODE})
"""Losses that leave the codewords of a page undecoded."""
_LISTED = 200
"""Unread pages that are listed with their reasons."""
_NAMED = 20
"""Parts of an enumeration."""
_OF_VOLUME = " of the volume, parity included"
_UNKNOWN, _NO_SYMBOLS = "unknown: no page of it could be read", "unknown: the recording has no symbols"


class PageResult(Part):
    """Result of a recorded page; see `lightpage.runtime.archives.recordings.recovery.RecoveredPage`."""

    page: Count
    number: Count | None
    volume: Count | None
    loss: Loss | None
    reason: str
    margin_bits: Margin | None
    failed_blocks: Count
    healed_rounds: Count | None = None


class _Volume(Part):
    volume: Count
    file_bytes: Count
    page_bytes: Annotated[Count, Field(gt=0)]
    data_pages: Count
    parity_pages: Count
    checksum: Count

    @model_validator(mode="after")
    def _check(self) -> Self:
        try:
            _ = self.whole
        except InvalidInputError as error:
            raise ValueError(str(error)) from None
        return self

    @property
    def whole(self) -> Volume:
        return Volume(self.volume, self.file_bytes, self.page_bytes, self.data_pages, self.parity_pages, self.checksum)


class _Recovery(Part):
    """The keys of the JSON that a report is made of."""

    code: Code
    volume: _Volume | None
    pages: Count
    pages_unread: Count
    pages_repeated: Count
    lost: list[Count]
    restored: list[Count]
    missing: list[Count]
    user_bytes_per_page: Annotated[Count, Field(gt=0)]
    blocks_per_page: Annotated[Count, Field(gt=0)]
    air_bytes_per_page: float | None
    share_of_air: float | None
    Q: Annotated[Bits, Field(gt=0)]
    q: Share
    page_failure_rate: Share | None
    page_failure_rate_bound_95: Share
    margin_bits_mean: Margin | None
    margin_bits_least: Margin | None
    corrected: Count
    iterations: Annotated[float, Field(ge=0)] | None
    seconds_per_page: Seconds | None
    code_seconds_per_page: Seconds | None
    page_results: list[PageResult]

    @model_validator(mode="after")
    def _check(self) -> Self:
        unread = sum(page.loss is not None for page in self.page_results)
        if (len(self.page_results), unread) != (self.pages, self.pages_unread):
            told = f"pages, pages_unread: {self.pages}, {self.pages_unread}"
            raise ValueError(f"{told}, but page_results has {len(self.page_results)} pages, {unread} of them unread")
        failed = max((page.failed_blocks for page in self.page_results), default=0)
        if failed > self.blocks_per_page:
            raise ValueError(f"failed_blocks: {failed} of the {self.blocks_per_page} of a page")
        return self


@dataclass(frozen=True)
class RecoveryData:
    """Everything that the report of a recovery shows.

    Attributes:
        title: title of the page.
        told: outcome of the file, in a sentence.
        cards: the figures that matter most, (name, value, unit).
        facts: the others, (name, value).
        pages: every recorded page.
        blocks_per_page: LDPC blocks that each of them holds.
        missing: pages of the volume that gave no bytes, recorded or not, for people; empty where all did.
        causes: causes of pages without bytes: cause, what it means, how many, their share of all.
        unread: pages that gave no bytes, the first ones only.
        more_unread: how many there are besides.
    """

    title: str
    told: str
    cards: list[tuple[str, str, str]]
    facts: list[tuple[str, str]]
    pages: Sequence[PageResult]
    blocks_per_page: int
    missing: str
    causes: list[tuple[str, str, int, float]]
    unread: Sequence[PageResult]
    more_unread: int

    @property
    def summary(self) -> str:
        """Headline figure, in a few words."""
        return f"{len(self.unread) + self.more_unread} of {len(self.pages)} pages unread"


def report_of_recovery(file: JsonFile) -> RecoveryData:
    """Read what became of a file and of its pages.

    Raises:
        InvalidInputError: not such JSON.
    """
    found = file.checked(_Recovery)
    unread = [page for page in found.page_results if page.loss is not None]
    counts = Counter(page.loss for page in unread)
    volume = found.volume
    return RecoveryData(
        title="Recovery of a file" if volume is None else f"Recovery of the file of volume {volume.volume}",
        told=_told(found),
        cards=_cards(found),
        facts=_facts(found),
        pages=found.page_results,
        blocks_per_page=found.blocks_per_page,
        missing=_numbered(found.missing, "page", _OF_VOLUME) if found.missing else "",
        causes=[
            (loss.value, meaning, counts[loss], counts[loss] / found.pages)
            for loss, meaning in LOSSES.items()
            if counts[loss]
        ],
        unread=unread[:_LISTED],
        more_unread=max(0, len(unread) - _LISTED),
    )


def _told(found: _Recovery) -> str:
    if found.volume is None:
        return "No page of the file could be read, so that nothing is known of it."
    if found.lost:
        lost = _count(found.lost, "data page")
        return f"{lost} lost. The file was not written, or with zeros in their place where --holes asked for it."
    restored = f", {_count(found.restored, 'data page')} of it from parity pages" if found.restored else ""
    return f"All {found.volume.file_bytes:,} bytes of the file came back{restored}."


def _cards(found: _Recovery) -> list[tuple[str, str, str]]:
    share, margin = found.share_of_air, found.margin_bits_least
    return [
        ("Unread", f"{found.pages_unread:,}", f"of {found.pages:,} pages"),
        ("Missing", f"{len(found.missing):,}", "pages of the volume"),
        ("Restored", f"{len(found.restored):,}", "data pages"),
        ("Lost", f"{len(found.lost):,}", "data pages"),
        ("Least margin", _told_if(margin, ".3f"), "bit/symbol"),
        ("User bytes", f"{found.user_bytes_per_page:,}", "a page"),
        ("Share of the AIR", _told_if(share, ".3f"), "of 1"),
    ]


def _facts(found: _Recovery) -> list[tuple[str, str]]:
    volume = None if found.volume is None else found.volume.whole
    own = None if volume is None else volume.id
    others = Counter(page.volume for page in found.page_results if page.loss is None and page.volume != own)
    return [
        ("Code", found.code.describe()),
        ("Volume", _UNKNOWN if volume is None else _shape(volume)),
        ("File size", _UNKNOWN if volume is None else f"{volume.file_bytes:,} bytes"),
        ("Recorded pages", f"{found.pages:,}"),
        ("Unread", f"{found.pages_unread:,} of the recorded pages"),
        ("Healed", _healed([page for page in found.page_results if page.healed_rounds is not None])),
        ("Repeated", f"{found.pages_repeated:,} of the recorded pages"),
        ("Pages of other volumes", _few([f"{count:,} of volume {other}" for other, count in others.most_common()])),
        ("Missing", _numbered(found.missing, "page", _OF_VOLUME)),
        ("Restored", _numbered(found.restored, "data page")),
        ("Lost", _numbered(found.lost, "data page")),
        ("User bytes a page", f"{found.user_bytes_per_page:,}"),
        ("AIR bytes a page", _told_if(found.air_bytes_per_page, ",.0f", no=_NO_SYMBOLS)),
        ("Share of the AIR", _told_if(found.share_of_air, ".3f", no=_NO_SYMBOLS)),
        ("Q, q", f"{found.Q:.3f} user bits a symbol, {found.q:.3f} of the raw bits"),
        (
            "Page failure rate",
            f"{_told_if(found.page_failure_rate, '.4f')}, with 95% confidence at most "
            f"{found.page_failure_rate_bound_95:.4f}",
        ),
        (
            "Margin of pages that were read",
            f"{_told_if(found.margin_bits_mean, '.3f', ' bit a symbol')} in the mean, "
            f"{_told_if(found.margin_bits_least, '.3f', ' bit a symbol')} at least",
        ),
        ("Corrected", f"{found.corrected:,} symbols by Reed-Solomon"),
        ("Iterations", _told_if(found.iterations, ".1f", " a codeword, mean of pages that were read")),
        (
            "Time",
            f"{_told_if(found.seconds_per_page, '.3f', ' s a page')}, code alone "
            f"{_told_if(found.code_seconds_per_page, '.3f', ' s')}; medians",
        ),
    ]


def _healed(pages: list[PageResult]) -> str:
    """Return the recorded pages that only the healed model read, and its rounds of fits to decisions."""
    if not pages:
        return "none"
    rounds = ranges(sorted({page.healed_rounds or 0 for page in pages}))
    return f"{_numbered([page.page for page in pages], 'recorded page')}; the model was healed in {rounds} rounds"


def _shape(volume: Volume) -> str:
    group = f"{volume.data_pages} data and {volume.parity_pages} parity pages"
    return f"{volume.id}: {volume.pages:,} pages in groups of {group}"


def _told_if(value: float | None, form: str, unit: str = "", *, no: str = "not known") -> str:
    return no if value is None else f"{value:z{form}}".replace("-", "−") + unit


def _count(pages: list[int], what: str) -> str:
    return f"{len(pages):,} {what}" if len(pages) == 1 else f"{len(pages):,} {what}s"


def _numbered(pages: list[int], what: str, more: str = "") -> str:
    return f"{_count(pages, what)}{more}: {_few(ranges(pages).split(', '))}" if pages else "none"


def _few(parts: list[str]) -> str:
    """An enumeration that does not grow without end."""
    more = f" and {len(parts) - _NAMED:,} more" if len(parts) > _NAMED else ""
    return ", ".join(parts[:_NAMED]) + more if parts else "none"
