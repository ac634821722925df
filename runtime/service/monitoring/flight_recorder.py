"""Keeps the frames of pages that went wrong, so that an engineer can look at them later: a bounded ring of files."""

import logging
import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import Field

from lightpage.errors import InvalidInputError, LightpageError, LimitError, Reason
from lightpage.page.levels import MAX_LEVELS
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import frame_type
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.service.limits import GRACE_S
from lightpage.runtime.service.models.loader import Model
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.table import Folder, SettingsTable

_log = logging.getLogger(__name__)

NOTE = "flight"
"""Group of a kept page's recording whose attributes say why it was kept."""

_WAITING = 4
"""Pages that wait for the disk; each lies in memory."""
_PATTERN = "page-*.h5"
_UNFINISHED = "page-*.partial"


class FileRing:
    """Files whose names sort by time. It is for one thread of one process; other files of the folder are left alone.

    Args:
        folder: made if absent.
        count: files at most.
        most_bytes: largest size of them all.

    Raises:
        InvalidInputError: the folder cannot be made.
    """

    def __init__(self, folder: Path, count: int, most_bytes: int) -> None:
        self._folder, self._count, self._most_bytes = folder, count, most_bytes
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InvalidInputError(f"folder {folder}", error, "one that can be made") from None
        for left in folder.glob(_UNFINISHED):
            with suppress(OSError):
                left.unlink()

    def add(self, time_s: float, reason: str, write: Callable[[Path], None]) -> Path:
        """Have `write` write a file, and drop the oldest ones beyond what is kept.

        Args:
            time_s: seconds since 1970.
            reason: a word, part of the name.
            write: is given the path.

        Returns:
            the file's path.

        Raises:
            LimitError: the file alone is larger than what is kept; it is dropped.
            OSError: an old file cannot be dropped; whatever `write` raises comes through.
        """
        when = datetime.fromtimestamp(time_s, UTC).strftime("%Y%m%dT%H%M%S.%f")
        path, number = self._folder / f"page-{when}-{reason}.h5", 1
        while path.exists():
            path, number = self._folder / f"page-{when}-{reason}-{number}.h5", number + 1
        self._drop(self._count - 1, self._most_bytes)  # first, since a full disk may be full of them
        try:
            write(path)
        except BaseException:
            path.with_name(path.name + ".partial").unlink(missing_ok=True)
            raise
        if (size := path.stat().st_size) > self._most_bytes:
            path.unlink()
            raise LimitError(f"file {path}", f"{size} bytes", f"at most {self._most_bytes} in all")
        self._drop(self._count, self._most_bytes)
        return path

    def files(self) -> list[Path]:
        """The files that are there, the oldest first."""
        return sorted(self._folder.glob(_PATTERN))

    def _drop(self, count: int, most_bytes: int) -> None:
        files = self.files()
        sizes = [path.stat().st_size for path in files]
        while files and (len(files) > count or sum(sizes) > most_bytes):
            files.pop(0).unlink(missing_ok=True)
            sizes.pop(0)


class FlightSettings(SettingsTable):
    """Folder and limits of the flight recorder: the table [flight_recorder] of the service's settings."""

    folder: Folder | None = Field(None, description="Folder in which the frames of lost and weak pages are kept.")
    pages: int = Field(64, ge=1, le=1_000_000, description="Pages kept there at most.")
    ring_bytes: int = Field(1 << 30, ge=1)
    """Bytes of all kept pages: 64 pages of a bench device take 160 MB, 25 of a 20-megapixel device all of it."""
    low_margin_bits: float = Field(0.05, ge=0, le=8, allow_inf_nan=False)
    """Margin below which a page is kept, bits a symbol: that of one in ten thousand of a quiet bench device."""
    read_every_s: float = Field(60.0, ge=0, le=31e6, allow_inf_nan=False)
    """Time in which one page is kept of those that were read, with a low margin or while a recalibration is due,
    seconds: more would push out the pages that show how it began."""


@dataclass(frozen=True)
class _Kept:
    """A page on its way to the disk, and the model that decoded it."""

    observation: Observation
    reason: str
    detail: str
    model: Model


class FlightRecorder:
    """Writes pages that went wrong to a folder, an `Observer`; to be used in a `with` statement.

    Pages are written by a thread of its own. Whatever the disk does, no read waits for it.

    Args:
        folder: made if absent; what an earlier service kept there counts.
        models: the models, whose device the pages are of.
        settings: what is kept.
        monitor: says whether a recalibration is due, None for never.
        metrics: what is counted.

    Raises:
        InvalidInputError: the folder cannot be made.
    """

    def __init__(
        self,
        folder: Path,
        models: Models,
        settings: FlightSettings | None = None,
        monitor: Monitor | None = None,
        metrics: ServiceMetrics | None = None,
    ) -> None:
        self._models, self._settings, self._monitor = models, settings or FlightSettings(), monitor
        self._metrics = metrics or ServiceMetrics()
        self._ring = FileRing(folder, self._settings.pages, self._settings.ring_bytes)
        self._waiting: queue.Queue[_Kept | None] = queue.Queue(_WAITING)
        self._lock = threading.Lock()
        """Guards the time below."""
        self._read_at = -float("inf")
        self._well = True
        self._thread = threading.Thread(target=self._write_all, name="lightpage-flight-recorder", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Write what waits, and end the thread, which is waited for at most `GRACE_S`."""
        try:
            self._waiting.put(None, timeout=GRACE_S)
        except queue.Full:
            _log.warning("flight recorder: not stopped after %.1f s, left to itself", GRACE_S)
            return
        self._thread.join(GRACE_S)

    def observe(self, observation: Observation) -> None:
        """See `Observer`."""
        if observation.pair is None or (why := self._why(observation)) is None:
            return
        held = [model for model in self._models.loaded if model.version == observation.model_version]
        kept = _Kept(observation, *why, held[0] if held else self._models.current)
        try:
            self._waiting.put_nowait(kept)
        except queue.Full:
            self._metrics.flight_pages.labels("dropped").inc()

    def _why(self, seen: Observation) -> tuple[str, str] | None:
        """A word and a sentence why a page is kept; None where it is not."""
        if seen.lost is not None:
            word = "FRAMES_DISAGREE" if seen.lost is Reason.UNSPECIFIED else seen.lost.value
            return word, seen.detail
        data = seen.user_data
        if data is not None and data.loss is not None:
            return f"{data.loss.value}_lost".upper(), f"{data.failed_blocks} of {data.blocks} blocks failed"
        if data is not None and data.margin_bits < self._settings.low_margin_bits:
            why = "LOW_MARGIN", f"margin {data.margin_bits:.4f} bit a symbol"
        elif seen.of_device and self._monitor is not None and self._monitor.due:
            why = "RECALIBRATION_DUE", "; ".join(self._monitor.state().reasons)
        else:
            return None
        with self._lock:
            if seen.time_s - self._read_at < self._settings.read_every_s:
                return None
            self._read_at = seen.time_s
        return why

    def _write_all(self) -> None:
        while (kept := self._waiting.get()) is not None:
            try:
                self._ring.add(kept.observation.time_s, kept.reason, partial(_write, kept))
            except Exception as error:
                self._metrics.flight_pages.labels("failed").inc()
                if self._well:
                    unforeseen = None if isinstance(error, LightpageError | OSError) else error
                    _log.warning("flight recorder: pages are not kept: %s", error, exc_info=unforeseen)
                self._well = False
            else:
                self._metrics.flight_pages.labels("kept").inc()
                if not self._well:
                    _log.info("flight recorder: pages are kept again")
                self._well = True


def _write(kept: _Kept, path: Path) -> None:
    """Write a page as a recording of its own, with the reference frames of the model that decoded it.

    Raises:
        RecordingError: it cannot be written, or is not of the model's device.
        InvalidInputError: the model holds no reference frames.
    """
    seen, decoder = kept.observation, kept.model.decoder
    assert seen.pair is not None  # pages without frames are not kept
    bit_depth = decoder.bundle.manifest.camera_bit_depth
    own = MAX_LEVELS if seen.page is None else seen.page.levels
    levels = own if seen.levels is None else seen.levels
    references = _counts(decoder.references, bit_depth)
    with RecordingWriter(path, decoder.bundle.profile, levels, bit_depth, references, seen.pilot_mask) as writer:
        writer.append(seen.symbols, seen.pair, infos=seen.infos)
        writer.add_note(NOTE, _note(kept))


def _note(kept: _Kept) -> dict[str, str | float]:
    """Why a page was kept, and what is known of it."""
    seen = kept.observation
    data, page = seen.user_data, seen.page
    note: dict[str, str | float | None] = {
        "reason": kept.reason,
        "detail": kept.detail,
        "subject": seen.subject,
        "model_version": seen.model_version,
        "time_s": seen.time_s,
        "page_index": seen.page_index,
        "margin_bits": None if data is None else data.margin_bits,
        "pilot_share": None if page is None else page.check.share,
        "pilot_trust": None if page is None else page.pilot_trust,
    }
    return {name: value for name, value in note.items() if value is not None}


def _counts(frames: FramePair, bit_depth: int) -> FramePair:
    """Frames of a table, which are floating-point numbers, as camera counts."""
    most, kind = 2**bit_depth - 1, frame_type(bit_depth)
    arrays = [np.clip(np.rint(frame), 0, most).astype(kind) for frame in (frames.in_phase, frames.quadrature)]
    return FramePair(*arrays)
