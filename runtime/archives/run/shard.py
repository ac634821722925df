"""The result of one range on the disk: a JSON file that says what became of each page, and beside it what they gave."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from lightpage.codec.header import parse_header
from lightpage.codec.page_bytes import FILE_BYTES, FileFacts, PageBytes
from lightpage.errors import InvalidInputError, LightpageError
from lightpage.failures import os_errors
from lightpage.files import replace_file, replace_text
from lightpage.metrics.reliability import ConfidenceBin
from lightpage.runtime.archives.run.task import NamedBundle, Plain

RECORD, SYMBOLS, USER_BYTES, BUNDLE, TRAINING, LOG = ".json", ".h5", ".npz", ".zip", ".run", ".log"
"""Ends of the names of a shard's files. The record is written last: without one, there is no result."""


_WRITTEN = "what a bulk run has written; delete it to redo it"


class PageState(StrEnum):
    """Outcome of a page."""

    READ = "read"
    LOST = "lost"
    LEFT_OUT = "left out"
    """The bundle was made from it, so that it says nothing of what the bundle is worth."""


class PageRecord(Plain):
    """A page of a shard, and its outcome.

    Attributes:
        page: its number in the recording.
        state: whether it was read.
        loss: why not, for programs: a `lightpage.errors.Reason`, a `lightpage.codec.page_bytes.Loss`, or the name of an
            error.
        reason: the same for people.
        recalibration_due: whether it shows that the device has changed.
        confirmed_bits: information a symbol that its pilots confirm; None where that is not told.
        figures: further figures of the page, by operation.
    """

    page: int
    state: PageState
    loss: str | None = None
    reason: str = ""
    recalibration_due: bool = False
    confirmed_bits: float | None = None
    figures: dict[str, float | int | None] = Field(default_factory=dict)

    @property
    def well(self) -> bool:
        """Return whether no other model could do better: the page was read, and the device is as it was calibrated."""
        return self.state is PageState.LEFT_OUT or (self.state is PageState.READ and not self.recalibration_due)

    def better_than(self, earlier: PageRecord) -> bool:
        """Return whether this reading of a page counts in place of an earlier one: its pilots do not confirm less."""
        if self.state is not PageState.READ or earlier.state is not PageState.READ:
            return self.state is PageState.READ
        return (self.confirmed_bits or 0.0) >= (earlier.confirmed_bits or 0.0)


class Findings(Plain):
    """Outcomes of the pages of a range.

    Attributes:
        pages: one each, in order.
        confidence_bins: bins of confidence of an evaluation, see `lightpage.metrics.accumulator`.
        summary: summary of a recalibration, as `lightpage recalibrate --json` has it; else empty.
    """

    pages: tuple[PageRecord, ...]
    confidence_bins: tuple[ConfidenceBin, ...] = ()
    summary: dict[str, float | str | None] = Field(default_factory=dict)

    @property
    def lost(self) -> dict[str, int]:
        """Pages that are lost, by cause."""
        return dict(Counter(page.loss or "" for page in self.pages if page.state is PageState.LOST))

    @property
    def left_out(self) -> int:
        """Pages that the bundle was made from."""
        return sum(page.state is PageState.LEFT_OUT for page in self.pages)


class ShardRecord(Findings):
    """Findings, and how they came about.

    Attributes:
        model: what read the pages.
        seconds: time that it took.
        finished_s: when it was done, seconds since 1970 by the worker's clock.
        worker: who did it, host and process.
        read_bytes: bytes read of frames, as they lie in the recording.
    """

    model: NamedBundle
    seconds: float
    finished_s: float
    worker: str
    read_bytes: int

    def write(self, shard: Path) -> None:
        """Write it, whole or not at all; the range is done then.

        Raises:
            InvalidInputError: it cannot be written.
        """
        replace_text(record_of(shard), self.model_dump_json() + "\n", "shard")

    @classmethod
    def read(cls, shard: Path) -> ShardRecord:
        """Return what `write` has written.

        Raises:
            InvalidInputError: it cannot be read.
        """
        path = record_of(shard)
        try:
            return cls.model_validate_json(_content(path))
        except ValidationError as error:
            raise InvalidInputError(f"shard {path}", error, _WRITTEN) from None


_LOST = f'"state":"{PageState.LOST}"'.encode()
"""In the record of a shard with lost pages."""


def holds_losses(shard: Path) -> bool:
    """Return whether a shard's record holds lost pages; it need not be parsed for that.

    Raises:
        InvalidInputError, StorageError: the record cannot be read.
    """
    return _LOST in _content(record_of(shard))


def _content(path: Path) -> bytes:
    with os_errors(f"shard {path}", "a file that can be read"):
        return path.read_bytes()


def record_of(shard: Path) -> Path:
    """Path of a shard's record."""
    return with_end(shard, RECORD)


def with_end(shard: Path, end: str) -> Path:
    """Path of one of a shard's files."""
    return shard.with_name(shard.name + end)


def write_user_bytes(shard: Path, pages: Sequence[tuple[int, PageBytes]]) -> None:
    """Write the user bytes of a range: each page's header, facts of its file, and data, by its recorded number.

    Raises:
        InvalidInputError: they cannot be written.
    """
    told = [
        (number, page.header.to_bytes(), page.file.to_bytes(), page.data)
        for number, page in pages
        if page.header is not None and page.file is not None and page.data is not None
    ]
    arrays: dict[str, Any] = {
        "pages": np.array([page for page, *_ in told], np.int64),
        "headers": np.array([list(header) for _, header, *_ in told], np.uint8),
        "files": np.array([list(facts) for _, _, facts, _ in told], np.uint8),
        "data": np.stack([np.frombuffer(data, np.uint8) for *_, data in told]) if told else np.zeros((0, 0), np.uint8),
    }
    replace_file(with_end(shard, USER_BYTES), lambda file: np.savez(file, **arrays), "shard")


def read_user_bytes(shard: Path) -> Iterable[tuple[int, PageBytes]]:
    """Return the contents of `write_user_bytes`: recorded numbers, and pages with header, file and data alone.

    Raises:
        InvalidInputError: it cannot be read.
    """
    path = with_end(shard, USER_BYTES)
    try:
        with np.load(io.BytesIO(_content(path)), allow_pickle=False) as arrays:
            numbers, headers, files, data = (arrays[name] for name in ("pages", "headers", "files", "data"))
    except LightpageError:
        raise
    except Exception as error:  # numpy and zipfile raise many kinds on damaged data
        raise InvalidInputError(f"shard {path}", error, _WRITTEN) from None
    for number, header, facts, content in zip(numbers.tolist(), headers, files, data, strict=True):
        file = FileFacts.parse(facts[:FILE_BYTES].tobytes())
        yield number, PageBytes(parse_header(header.tobytes()), content.tobytes(), file, None, 0.0, 0, 0, 0, 0.0)
