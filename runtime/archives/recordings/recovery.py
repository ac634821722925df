"""Reads a file back from recorded pages: frames to symbols, symbols to bytes, parity for what is lost."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from scipy.stats import beta

from lightpage.codec.code import Code
from lightpage.codec.page_bytes import LOSSES, Loss, PageBytes
from lightpage.codec.volume import Volume
from lightpage.codec.volume_file import Restored, VolumeFiles, ranges
from lightpage.device.problems import mistakes
from lightpage.errors import InvalidInputError, LightpageError, LostDataError, MissingResultsError, RecordingError
from lightpage.progress import track
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.page_reader import PageReader, RecoveredPage
from lightpage.runtime.archives.recordings.read_pages import ReadPages
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import Tracker

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Recovery:
    """A file that was read back, or what is left of it.

    Attributes:
        code: code of the pages.
        volume: volume of the file; None where no page could be read.
        pages: every page of the recording.
        restored, lost: see `lightpage.codec.volume_file.Restored`.
        missing: numbers of pages of the volume that gave no bytes, parity included.
        foreign: pages of other volumes, by "id:checksum", and of "others" beyond the number that is collected.
        repeated: pages that came again.
        user_bytes_per_page: user that a page holds.
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

    @property
    def healed(self) -> tuple[RecoveredPage, ...]:
        """Recorded pages that the model could not read before it was healed."""
        return tuple(page for page in self.pages if page.healed_rounds is not None)

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
            "pages_healed": len(self.healed),
            "pages_restored": len(self.restored),
            "pages_lost": len(self.lost),
            "pages_missing": len(self.missing),
            "pages_repeated": self.repeated,
            "lost": list(self.lost),
            "lost_bytes": [] if volume is None else volume.bytes_of(self.lost),
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
    text = recording.header.code_text
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
        raise RecordingError(subject, mistakes(Code, error), expected) from None
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
    heals: bool = True,
    known_out: Path | None = None,
) -> Recovery:
    """Read the file of one volume back; pages that storage does not give are unread, as those that are lost.

    Args:
        decoder: decoder of the device.
        recording: recording of its pages, in any order.
        tracker: follows the device from page to page.
        code: code of the pages.
        out: the file; written whole, or not at all: what is there stays then.
        volume_id, checksum: which volume; if left out, the recording must hold only one.
        holes: write zeros where data are lost, in place of no file.
        heals: whether the model is re-fitted by pages that it does not read.
        known_out: a recording of the pages that are read, of any volume, with their symbols.

    Raises:
        RecordingError: another device's recording, or one of other levels or pilots; or see `ReadPages.write`.
        InvalidInputError: several volumes and no choice between them, none of those asked for, pages that contradict
            each other, or no room.
        LostDataError: the file that was put together is not the one that was encoded.
    """
    reader = PageReader(decoder, recording, tracker, code)
    codec, mask = reader.codec, decoder.bundle.pilot_mask
    known = None if known_out is None else ReadPages(recording, decoder, code)
    with VolumeFiles(out) as files:

        def take(index: int, found: PageBytes) -> Volume | None:
            if known is not None:
                known.add(index, found)
            return files.add(found)

        read = reader.read(range(recording.pages), take, heals=heals)
        pages = tuple(sorted(track(read, "recover", total=recording.pages), key=lambda page: page.page))
        if known is not None and known_out is not None:
            known.write(known_out)
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
            pages,
            done.restored,
            done.lost,
            () if file is None else tuple(file.missing()),
            foreign,
            0 if file is None else file.repeated,
            codec.user_bytes,
            mask.size,
            int(np.count_nonzero(~mask)),
            codec.blocks,
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
    unreadable = [page for page in recovery.unread if page.loss is Loss.STORAGE]
    if unreadable and not give_up:
        pages = ranges([page.page for page in unreadable])
        got = f"no data of recorded pages {pages} from storage ({unreadable[0].reason})"
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
