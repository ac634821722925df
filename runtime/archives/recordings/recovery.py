"""Reads a file back from recorded pages: frames to symbols, symbols to bytes, parity for what is lost."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.stats import beta

from lightpage.codec.code import Code, problems_of
from lightpage.codec.page_bytes import LOSSES, Header, Loss, PageBytes
from lightpage.codec.page_codec import PageCodec
from lightpage.codec.volume import Successor, Volume
from lightpage.codec.volume_file import Restored, VolumeFiles, ranges
from lightpage.errors import (
    InvalidInputError,
    LightpageError,
    LostDataError,
    LostPageError,
    MissingResultsError,
    RecordingError,
    StorageError,
)
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import air_bits
from lightpage.runtime.archives.recordings.evaluation import check_recording
from lightpage.runtime.archives.recordings.read_ahead import read_ahead
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.page import DecodedPage
from lightpage.runtime.model.decoding.tracking import Tracker

CONFIDENCE = 0.95


@dataclass(frozen=True)
class RecoveredPage:
    """What became of one recorded page.

    Attributes:
        page: its number in the recording.
        number: its number in its volume: as read, or of a lost page as its header claims it; None where unknown.
        volume: the same of the volume.
        loss: why it gave no bytes; None where it did.
        reason: the same for people; empty where it did.
        margin_bits: information of a symbol's coded bits beyond what the code needs; None where there was no light.
        corrected: Reed-Solomon symbols that were mended.
        failed_blocks: LDPC blocks that did not converge.
        iterations: mean of the LDPC blocks.
        air_bits: AIR of the page as delivered, bits a data symbol; None where its symbols are not known.
        seconds: of the optical decode.
        code_seconds: of the code.
    """

    page: int
    number: int | None
    volume: int | None
    loss: Loss | None
    reason: str
    margin_bits: float | None = None
    corrected: int = 0
    failed_blocks: int = 0
    iterations: float = 0.0
    air_bits: float | None = None
    seconds: float = 0.0
    code_seconds: float = 0.0


@dataclass(frozen=True)
class Recovery:
    """A file that was read back, or what is left of it.

    Attributes:
        code: of the pages.
        volume: of the file; None where no page could be read.
        pages: every page of the recording.
        restored, lost: see `lightpage.codec.volume_file.Restored`.
        missing: numbers of pages of the volume that gave no bytes, parity included.
        foreign: pages of other volumes, by "id:checksum", and of "others" beyond the number that is collected.
        repeated: pages that came again.
        user_bytes_per_page: that a page holds.
        symbols_per_page: all of them, pilots included.
        data_symbols_per_page: without pilots.
        blocks_per_page: LDPC blocks that a page holds.
    """

    code: Code
    volume: Volume | None
    pages: tuple[RecoveredPage, ...]
    restored: tuple[int, ...]
    lost: tuple[int, ...]
    missing: tuple[int, ...]
    foreign: dict[str, int]
    repeated: int
    user_bytes_per_page: int
    symbols_per_page: int
    data_symbols_per_page: int
    blocks_per_page: int

    @property
    def unread(self) -> tuple[RecoveredPage, ...]:
        """Recorded pages that gave no bytes."""
        return tuple(page for page in self.pages if page.loss is not None)

    def reason_of(self, page: int) -> str:
        """Why a recorded page gave no bytes, for people."""
        return next(each.reason for each in self.pages if each.page == page)

    @property
    def failure_bound(self) -> float:
        """Rate of unread pages that is not exceeded with 95% confidence (Clopper and Pearson)."""
        failed, count = len(self.unread), len(self.pages)
        return 1.0 if failed >= count else float(beta.ppf(CONFIDENCE, failed + 1, count - failed))

    def to_json(self) -> dict[str, Any]:
        """The figures under the names that other programs read."""
        rates = [page.air_bits for page in self.pages if page.air_bits is not None]
        air_bytes = float(np.mean(rates)) * self.data_symbols_per_page / 8 if rates else None
        user, volume = self.user_bytes_per_page, self.volume
        bits = 8 * user / self.symbols_per_page
        read = [page for page in self.pages if page.loss is None]
        return {
            "pages": len(self.pages),
            "pages_unread": len(self.unread),
            "pages_restored": len(self.restored),
            "pages_lost": len(self.lost),
            "pages_missing": len(self.missing),
            "pages_repeated": self.repeated,
            "lost": list(self.lost),
            "restored": list(self.restored),
            "missing": list(self.missing),
            "other_volumes": self.foreign,
            "user_bytes": 0 if volume is None else volume.file_bytes,
            "user_bytes_per_page": user,
            "blocks_per_page": self.blocks_per_page,
            "air_bits_per_symbol": float(np.mean(rates)) if rates else None,
            "air_bytes_per_page": air_bytes,
            "share_of_air": user / air_bytes if air_bytes else None,
            "Q": bits,
            "q": bits / self.code.level_bits,
            "page_failure_rate": len(self.unread) / len(self.pages) if self.pages else None,
            "page_failure_rate_bound_95": self.failure_bound,
            "margin_bits_mean": float(np.mean([p.margin_bits for p in read])) if read else None,
            "margin_bits_least": float(min(p.margin_bits for p in read if p.margin_bits is not None)) if read else None,
            "corrected": sum(page.corrected for page in self.pages),
            "iterations": float(np.mean([page.iterations for page in read])) if read else None,
            "seconds_per_page": float(np.median([p.seconds + p.code_seconds for p in self.pages])),
            "code_seconds_per_page": float(np.median([p.code_seconds for p in read])) if read else None,
            "code": self.code.model_dump(),
            "volume": None if volume is None else volume.to_json(),
            "page_results": [asdict(page) for page in self.pages],
        }


def code_of(recording: Recording, bundle: Bundle) -> Code:
    """The code of a recording's pages: as it says itself, or else the bundle's.

    Raises:
        RecordingError: the recording's attribute `code` cannot be understood.
        InvalidInputError: neither has one.
    """
    text = recording.code_text
    if text is None:
        if bundle.code is None:
            expected = "--code CODE.toml, as `lightpage code` makes it"
            raise InvalidInputError(f"{bundle.subject}, recording {recording.path}", "no code in either", expected)
        return bundle.code
    subject, expected = f"recording {recording.path}: attribute 'code'", "the parameters of a code as JSON"
    try:
        told = json.loads(text)
        return Code.model_validate({key: told[key] for key in Code.model_fields if key in told})
    except ValidationError as error:
        raise RecordingError(subject, problems_of(error), expected) from None
    except (ValueError, TypeError) as error:
        raise RecordingError(subject, error, expected) from None


def recover(
    decoder: Decoder,
    recording: Recording,
    tracker: Tracker,
    code: Code,
    out: Path,
    volume_id: int | None = None,
    checksum: int | None = None,
    holes: bool = False,
) -> Recovery:
    """Read the file of one volume back; pages that storage does not give are unread, as those that are lost.

    Args:
        decoder: of the device.
        recording: of its pages, in any order.
        tracker: follows the device from page to page.
        code: of the pages.
        out: the file; written whole, or not at all: what is there stays then.
        volume_id, checksum: which volume; if left out, the recording must hold only one.
        holes: write zeros where data are lost, in place of no file.

    Raises:
        RecordingError: another device's recording, or one of other levels or pilots.
        InvalidInputError: several volumes and no choice between them, none of those asked for, pages that contradict
            each other, or no room.
        LostDataError: the file that was put together is not the one that was encoded.
    """
    reader = page_reader(decoder, recording, tracker, code)
    codec, bundle = reader.codec, decoder.bundle
    pages: list[RecoveredPage] = []
    with VolumeFiles(out) as files:
        for index, read in track(read_ahead(recording.shown, recording.pages), "recover", total=recording.pages):
            try:
                pages.append(read_page(reader, recording.bit_depth, index, read, files.add))
            except StorageError as error:
                pages.append(unread_page(reader, index, Loss.STORAGE, error))
        file = files.chosen(volume_id, checksum)
        done = Restored((), ()) if file is None else file.restore()
        if file is not None and (holes or not done.lost):
            file.complete(done.lost)
        volume = None if file is None else file.volume
        foreign = {f"{of.id}:{of.checksum:08x}": count for of, count in files.counts().items() if of != volume}
        if files.dropped:
            foreign["others"] = files.dropped
        return Recovery(
            code,
            volume,
            tuple(pages),
            done.restored,
            done.lost,
            () if file is None else tuple(file.missing()),
            foreign,
            0 if file is None else file.repeated,
            codec.user_bytes,
            bundle.pilot_mask.size,
            int(np.count_nonzero(~bundle.pilot_mask)),
            codec.blocks,
        )


class PageReader:
    """Frames to bytes, page after page; knows which page of its volume should come next.

    Args:
        codec: of the pages.
        decode: frame pair to decoded page.
    """

    def __init__(self, codec: PageCodec, decode: Callable[[FramePair], DecodedPage]) -> None:
        self.codec, self._decode = codec, decode
        self._next = Successor()

    @property
    def expected(self) -> Header | None:
        """The page that should come next, where that is known."""
        return self._next.header

    def read(self, pair: FramePair) -> tuple[DecodedPage, PageBytes, float, float]:
        """A page, its bytes, and the seconds of the optical decode and of the code.

        Raises:
            LostPageError, InvalidInputError: the frames cannot be decoded.
        """
        start = time.perf_counter()
        page = self._decode(pair)
        decoded = time.perf_counter()
        found = self.codec.decode(page.phase, page.concentration, self.expected)
        return page, found, decoded - start, time.perf_counter() - decoded

    def follow(self, volume: Volume | None, header: Header | None) -> None:
        """Take note of a page: of the volume that it belongs to, or of none, where it is lost."""
        if volume is not None and header is not None:
            self._next = Successor(volume, header)
        self.skip()

    def skip(self) -> None:
        """Go on to the page after the one that was expected."""
        self._next = self._next.after()


def page_reader(decoder: Decoder, recording: Recording, tracker: Tracker, code: Code) -> PageReader:
    """What reads the pages of a recording.

    Raises:
        RecordingError: another device's recording, or one of other levels or pilots.
    """
    check_recording(decoder, recording)
    bundle = decoder.bundle
    if recording.declared_levels not in (None, code.levels):
        raise RecordingError(f"recording {recording.path}: levels", recording.levels, f"{code.levels}, as the code has")
    own = recording.pilots()
    if own is not None and not np.array_equal(own, bundle.pilot_mask):
        raise RecordingError(f"recording {recording.path}: pilots", "other places", "those of the bundle")
    pilots = decoder.written_pilots(code.levels)
    return PageReader(PageCodec(code, bundle.pilot_mask), lambda pair: tracker.decode(pair, code.levels, pilots))


def unread_page(reader: PageReader, index: int, loss: Loss, error: LightpageError) -> RecoveredPage:
    """A page that gave nothing, which `reader` passes over.

    Args:
        reader: of the recording's pages.
        index: of the page.
        loss: why, for programs.
        error: why, for people.
    """
    expected = reader.expected
    reader.skip()
    number, volume = (None, None) if expected is None else (expected.page, expected.volume)
    return RecoveredPage(index, number, volume, loss, str(error))


def read_page(
    reader: PageReader,
    bit_depth: int,
    index: int,
    read: Future[tuple[FramePair, NDArray[np.uint8] | None]],
    take: Callable[[PageBytes], Volume | None],
) -> RecoveredPage:
    """Read one page of a recording.

    Args:
        reader: of its pages.
        bit_depth: of the recording.
        index: of the page.
        read: its frames and, where they are known, its symbols.
        take: takes the page, and says which volume it belongs to.

    Raises:
        StorageError: the frames could not be read, which says nothing of the page.
    """
    expected = reader.expected
    try:
        frames, symbols = read.result()
        page, found, seconds, code_seconds = reader.read(narrow(frames, bit_depth))
    except (InvalidInputError, LostPageError) as error:
        return unread_page(reader, index, Loss.OPTICS, error)
    reader.follow(take(found), found.header)
    header = found.header if found.header is not None else expected
    data = ~reader.codec.pilots
    rate = None if symbols is None else air_bits(page, symbols, data, reader.codec.code.levels)
    return RecoveredPage(
        index,
        None if header is None else header.page,
        None if header is None else header.volume,
        found.loss,
        "" if found.loss is None else LOSSES[found.loss],
        found.margin_bits,
        found.corrected,
        found.failed_blocks,
        found.iterations,
        rate,
        seconds,
        code_seconds,
    )


def told_losses(pages: Sequence[RecoveredPage]) -> list[str]:
    """A line for each cause by which pages gave no bytes, with the pages and, of one alone, the reason."""
    groups: dict[tuple[Loss, int | None], list[RecoveredPage]] = {}
    for page in pages:
        if page.loss is not None:
            groups.setdefault((page.loss, page.volume), []).append(page)
    lines = []
    for (loss, volume), some in groups.items():
        many = "s" if len(some) > 1 else ""
        numbers = ranges([page.number for page in some if page.number is not None])
        where = f" (page{many} {numbers} of volume {volume})" if numbers else ""
        reason = some[0].reason if len(some) == 1 else LOSSES[loss]
        lines.append(f"recorded page{many} {ranges([page.page for page in some])}{where}: {reason}")
    return lines


def lost_data(recovery: Recovery, out: Path, holes: bool, give_up: bool = False) -> LightpageError | None:
    """The error that `recover` ends with where data are lost, which names every page; None where none are.

    Args:
        recovery: what was read.
        out: the file.
        holes: whether it was written with zeros in place of what is lost.
        give_up: whether pages that storage did not give are lost too.

    Returns:
        A `LostDataError`, or a `MissingResultsError` where pages that storage did not give may still complete the file.
    """
    if recovery.volume is not None and not recovery.lost:
        return None
    unreadable = [page.page for page in recovery.unread if page.loss is Loss.STORAGE]
    if unreadable and not give_up:
        got = f"no data of recorded pages {ranges(unreadable)} from storage ({recovery.reason_of(unreadable[0])})"
        expected = "storage that gives them: the same command tries again; with --give-up they are lost"
        return MissingResultsError(f"file {out}", got, expected)
    told = "; ".join(told_losses(recovery.unread))
    unread = f"{len(recovery.unread)} of {len(recovery.pages)} pages gave no bytes ({told})" if told else ""
    if recovery.volume is None:
        expected = "at least one page that can be read: pages, bundle and code of this device"
        return LostDataError(f"file {out}", unread or "no page", expected)
    data = f"data pages {ranges(recovery.lost)} of volume {recovery.volume.id} lost"
    state = "written with zeros in their place" if holes else "not written; --holes writes it with zeros"
    got = f"{data}, {state}" + (f"; {unread}" if unread else "")
    return LostDataError(f"file {out}", got, f"at most {recovery.volume.parity_pages} lost pages a group")
