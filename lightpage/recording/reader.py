"""Recordings: frame pairs, reference frames and, where they are known, symbols, in one HDF5 file.

The layout is the contract with other people's devices. Root attributes: `format` = "lightpage-recording",
`version` = 1, `camera_bit_depth`, `levels` (256 if absent), optionally `profile` (the nominal profile as TOML text) and
`black_level` (counts of a camera in the dark, 0 if absent; taken off when frames are read).
Datasets: `in_phase` and `quadrature` [page, row, column], `reference_in_phase` and `reference_quadrature`
[row, column], uint8 or uint16, counts right-aligned; optionally `symbols` uint8 [page, ny, nx] and `pilots`, boolean
[ny, nx]. A simulator adds the group `truth`, which no decoder reads. Cameras add the group `cameras`, see `layout`.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile, parse_profile
from lightpage.errors import ProfileError, RecordingError
from lightpage.page.levels import MAX_LEVELS, MIN_LEVELS
from lightpage.progress import warn
from lightpage.recording.alignment import describe, unused_low_bits
from lightpage.recording.black_level import without_black
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.hdf5 import open_hdf5
from lightpage.recording.layout import (
    CAMERAS,
    DARK,
    FORMAT,
    FRAMES,
    HOT,
    LOSSES,
    MAX_BIT_DEPTH,
    MIN_BIT_DEPTH,
    REFERENCES,
    SHOT_DATA,
    VERSION,
    FrameInfo,
    LostShot,
    frame_type,
    hash_frames,
    page_hashes,
)
from lightpage.recording.stored import ArrayFile, StoredArray
from lightpage.recording.writer import RecordingWriter

__all__ = ["Recording", "RecordingWriter", "hash_frames", "page_hashes"]

_SYMBOL_PAGES_AT_ONCE = 64
"""Pages of symbols checked in one read, so that opening a long recording stays small in memory."""


class Recording:
    """A recording opened for reading and checked; use it in a `with` statement, or close it."""

    def __init__(self, file: h5py.File, path: Path) -> None:
        """Check `file`, which must be open for reading, and is closed with this; `Recording.open` is the usual way in.

        Raises:
            RecordingError: the file is not a recording, or it is inconsistent.
        """
        self.path = path
        self._alignment_told = False
        self._file = ArrayFile(file, f"recording {path}")
        try:
            self._check_header()
            self._check_frames()
            self._check_page()
            for name in (*SHOT_DATA, *DARK, *HOT, LOSSES):
                self._file.array(name)
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open and check a recording without reading its frames.

        Raises:
            RecordingError: missing, truncated, foreign, newer than this program, or inconsistent; the message names the
                file, the dataset or attribute, what came and what was wanted.
        """
        path = Path(path)
        return cls(open_hdf5(path, f"recording {path}"), path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; nothing can be read afterwards."""
        self._file.close()

    @property
    def pages(self) -> int:
        """Number of pages."""
        return self._shape[0]

    @property
    def levels(self) -> int:
        """Level count M of the symbols."""
        return self._levels

    @property
    def bit_depth(self) -> int:
        """Bits of a camera count; full scale is 2**bit_depth - 1."""
        return self._bit_depth

    @property
    def black_level(self) -> int:
        """Counts of a camera in the dark; `frames` and `references` are free of them."""
        return self._black_level

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Camera pixels as (rows, columns)."""
        return self._shape[1:]

    @property
    def page_shape(self) -> tuple[int, int] | None:
        """Symbols as (rows, columns), or None when the file holds neither symbols nor pilots."""
        for name in ("symbols", "pilots"):
            if (found := self._file.array(name)) is not None:
                rows, columns = found.shape[-2:]
                return rows, columns
        return None

    @property
    def stored_page_bytes(self) -> float:
        """Bytes that the frame pair of a page takes in the file, compressed as it is; mean over the pages.

        Of recordings that are shown as one, it is what their own files take.
        """
        return sum(self._array(name).stored_bytes for name in FRAMES) / max(1, self.pages)

    @property
    def has_symbols(self) -> bool:
        """Whether the written symbols are known."""
        return self._file.array("symbols") is not None

    @property
    def declared_levels(self) -> int | None:
        """Level count as the file states it, None where it does not."""
        return self._levels if self._attribute("levels") is not None else None

    @property
    def code_text(self) -> str | None:
        """What the pages hold, JSON text, or None: then they were not made by an encoder, or it was not noted."""
        text = self._attribute("code")
        return text if isinstance(text, str) else None

    @property
    def profile_text(self) -> str | None:
        """The nominal profile as TOML text, or None."""
        return self._profile_text

    def frames(self, page: int) -> FramePair:
        """The frame pair of one page, its black level taken off.

        Raises:
            RecordingError: no such page, or its data cannot be read.
        """
        return FramePair(*(self._read_page(name, page) for name in FRAMES))

    def references(self) -> FramePair:
        """The two reference-only frames, their black level taken off.

        Raises:
            RecordingError: the data cannot be read.
        """
        return FramePair(*(self._read(name) for name in REFERENCES))

    def shown(self, index: int) -> tuple[FramePair, NDArray[np.uint8] | None]:
        """Frames and symbols of a page; see `frames` and `symbols`."""
        return self.frames(index), self.symbols(index)

    def symbols(self, page: int) -> NDArray[np.uint8] | None:
        """The symbols [ny, nx] of one page, or None when the file holds none.

        Raises:
            RecordingError: no such page, or its data cannot be read.
        """
        return self._read_page("symbols", page) if self.has_symbols else None

    def pilots(self) -> NDArray[np.bool_] | None:
        """The recording's own pilot positions [ny, nx], or None: then the profile's default positions hold.

        Raises:
            RecordingError: the data cannot be read.
        """
        return self._read("pilots").astype(np.bool_) if self._file.array("pilots") is not None else None

    def frame_infos(self, page: int) -> tuple[FrameInfo, FrameInfo] | None:
        """What the cameras said of a page's in-phase and quadrature frame, or None where that was not noted.

        Raises:
            RecordingError: no such page, or the data cannot be read, or do not fit the frames.
        """
        known = [self._file.array(name) for name in SHOT_DATA]
        if None in known:
            return None
        subject, expected = self._subject(f"group '{CAMERAS}'"), f"({self.pages}, 2), and two serials and pixel formats"
        names = [self._file.attribute(name, group=CAMERAS) for name in ("serials", "pixel_formats")]
        shapes = {array.shape for array in known if array is not None}
        if shapes != {(self.pages, 2)} or any(np.shape(name) != (2,) for name in names):
            raise RecordingError(subject, f"shapes {sorted(shapes)}, {names}", expected)
        ids, device, host, exposures = (self._read_page(name, page) for name in SHOT_DATA)
        first, second = (
            FrameInfo(
                str(names[0][one]),
                int(ids[one]),
                float(device[one]),
                float(host[one]),
                str(names[1][one]),
                None if np.isnan(exposures[one]) else float(exposures[one]),
            )
            for one in (0, 1)
        )
        return first, second

    def dark_frames(self) -> FramePair | None:
        """What the cameras saw without light, as it was, or None where that was not recorded."""
        if any(self._file.array(name) is None for name in DARK):
            return None
        return FramePair(*(self._read(name) for name in DARK))

    def hot_pixels(self) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
        """Row and column [n, 2] of the pixels of each camera that were mended, or None where that was not noted."""
        if any(self._file.array(name) is None for name in HOT):
            return None
        first, second = (self._read(name).astype(np.intp).reshape(-1, 2) for name in HOT)
        return first, second

    def losses(self) -> list[LostShot]:
        """Shots that gave no page.

        Raises:
            RecordingError: a note that cannot be read.
        """
        if self._file.array(LOSSES) is None:
            return []
        try:
            return [LostShot(**json.loads(text)) for text in self._read(LOSSES)]
        except (TypeError, ValueError) as error:
            raise RecordingError(self._subject(f"dataset '{LOSSES}'"), error, "notes of lost shots") from None

    def page_hash(self, page: int) -> str:
        """SHA-256 of one frame pair in hex, by which pages that were trained on are recognised; see `page_hashes`.

        Raises:
            RecordingError: no such page, or its data cannot be read.
        """
        return hash_frames(self.frames(page))

    def check_against(self, profile: Profile) -> None:
        """Check that the recording belongs to devices of this profile.

        Raises:
            RecordingError: frames or page of another shape.
        """
        if self.frame_shape != profile.frame_shape:
            raise RecordingError(
                self._subject("in_phase"),
                f"frames of {_size(self.frame_shape)} pixels",
                f"{_size(profile.frame_shape)} (profile {profile.name})",
            )
        if self.page_shape not in (None, profile.page_shape):
            raise RecordingError(
                self._subject("symbols" if self.has_symbols else "pilots"),
                f"pages of {_size(self.page_shape)} symbols",
                f"{_size(profile.page_shape)} (profile {profile.name})",
            )

    def own_profile(self) -> Profile | None:
        """The nominal profile that the recording carries; None where it has none that can be read."""
        try:
            return None if self._profile_text is None else parse_profile(self._profile_text, "profile of the recording")
        except ProfileError:
            return None

    def differences(self, profile: Profile) -> list[str]:
        """What the recording's own nominal profile says otherwise than `profile`, a line each.

        Empty where it has none that can be read: another program's notes are no reason to stop.
        """
        own = self.own_profile()
        if own is None:
            return []
        told, expected = own.model_dump(), profile.model_dump()
        return [
            f"{table}.{key} = {value} (profile {profile.name}: {expected[table][key]})"
            for table, values in told.items()
            if isinstance(values, dict)
            for key, value in values.items()
            if expected[table][key] != value
        ]

    def _subject(self, name: str) -> str:
        return f"recording {self.path}: {name}"

    def _attribute(self, name: str, default: object = None) -> Any:
        """A root attribute as a plain Python value."""
        return self._file.attribute(name, default)

    def _whole(self, name: str, default: int | None = None) -> int:
        value = self._attribute(name, default)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int):
            raise RecordingError(
                self._subject(f"attribute '{name}'"), "none" if value is None else repr(value), "a whole number"
            )
        return value

    def _check_header(self) -> None:
        format_name = self._attribute("format")
        if format_name != FORMAT:
            got = "none" if format_name is None else repr(format_name)
            raise RecordingError(self._subject("attribute 'format'"), got, repr(FORMAT))
        version = self._whole("version")
        if version != VERSION:
            raise RecordingError(self._subject("attribute 'version'"), version, f"version {VERSION}")
        self._bit_depth = self._whole("camera_bit_depth")
        if not MIN_BIT_DEPTH <= self._bit_depth <= MAX_BIT_DEPTH:
            raise RecordingError(
                self._subject("attribute 'camera_bit_depth'"), self._bit_depth, f"{MIN_BIT_DEPTH} to {MAX_BIT_DEPTH}"
            )
        self._levels = self._whole("levels", MAX_LEVELS)
        if not MIN_LEVELS <= self._levels <= MAX_LEVELS:
            raise RecordingError(
                self._subject("attribute 'levels'"), self._levels, f"a whole number from {MIN_LEVELS} to {MAX_LEVELS}"
            )
        self._black_level = self._whole("black_level", 0)
        full_scale = 2**self._bit_depth - 1
        if not 0 <= self._black_level < full_scale:
            raise RecordingError(
                self._subject("attribute 'black_level'"), self._black_level, f"0 to {full_scale - 1} counts"
            )
        text = self._attribute("profile")
        if text is not None and not isinstance(text, str):
            raise RecordingError(self._subject("attribute 'profile'"), type(text).__name__, "TOML text")
        self._profile_text: str | None = text

    def _array(self, name: str) -> StoredArray:
        found = self._file.array(name)
        if found is None:
            raise RecordingError(self._subject(f"dataset '{name}'"), "none", "an array")
        return found

    def _dataset(self, name: str, dimensions: int) -> StoredArray:
        found = self._array(name)
        if len(found.shape) != dimensions:
            raise RecordingError(found.subject, f"shape {found.shape}", f"{dimensions} dimensions")
        return found

    def _check_frames(self) -> None:
        first = self._dataset("in_phase", 3)
        pages, rows, columns = first.shape
        self._shape = pages, rows, columns
        wanted_type = frame_type(self._bit_depth)
        for name, shape in {
            "in_phase": first.shape,
            "quadrature": first.shape,
            "reference_in_phase": first.shape[1:],
            "reference_quadrature": first.shape[1:],
        }.items():
            dataset = self._dataset(name, len(shape))
            subject = self._subject(f"dataset '{name}'")
            # 8-bit counts may come in either type; more bits fit into uint16 only.
            fits = dataset.dtype.kind == "u" and wanted_type.itemsize <= dataset.dtype.itemsize <= 2
            if not fits:
                raise RecordingError(subject, f"type {dataset.dtype}", f"{wanted_type} for {self._bit_depth} bits")
            if dataset.shape != shape:
                raise RecordingError(subject, f"shape {dataset.shape}", f"shape {shape}, as 'in_phase' has")
            if 0 in dataset.shape:
                raise RecordingError(subject, f"shape {dataset.shape}", "at least one page and one pixel")

    def _check_page(self) -> None:
        if self._file.array("pilots") is not None:
            pilots = self._dataset("pilots", 2)
            if pilots.dtype.kind not in "bui":
                raise RecordingError(self._subject("dataset 'pilots'"), f"type {pilots.dtype}", "booleans")
            known, size = np.count_nonzero(self._read("pilots")), math.prod(pilots.shape)
            if not 0 < known < size:
                raise RecordingError(
                    self._subject("dataset 'pilots'"),
                    f"{known} pilots of {size} symbols",
                    "some of them, not all",
                )
        if not self.has_symbols:
            return
        symbols = self._dataset("symbols", 3)
        subject = self._subject("dataset 'symbols'")
        if symbols.dtype != np.uint8:
            raise RecordingError(subject, f"type {symbols.dtype}", "uint8")
        if symbols.shape[0] != self.pages or 0 in symbols.shape[1:]:
            raise RecordingError(subject, f"shape {symbols.shape}", f"shape ({self.pages}, ny, nx), as 'in_phase' has")
        if (own := self._file.array("pilots")) is not None and own.shape != symbols.shape[1:]:
            raise RecordingError(
                own.subject,
                f"shape {own.shape}",
                f"shape {symbols.shape[1:]}, as 'symbols' has",
            )
        for start in range(0, self.pages, _SYMBOL_PAGES_AT_ONCE):
            chunk = self._read("symbols", start, min(start + _SYMBOL_PAGES_AT_ONCE, self.pages))
            if int(chunk.max()) >= self._levels:
                raise RecordingError(
                    subject, f"a symbol of {chunk.max()}", f"0 to {self._levels - 1}, since levels = {self._levels}"
                )

    def _read_page(self, name: str, page: int) -> NDArray[Any]:
        if not 0 <= page < self.pages:
            raise RecordingError(self._subject("page"), page, f"0 to {self.pages - 1}")
        frame: NDArray[Any] = self._read(name, page, page + 1)[0]
        if name in FRAMES:
            self._check_counts(name, frame, f" page {page}")
            frame = self._without_black(frame)
        return frame

    def _read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """An array, or its rows from `start` to `stop`, in this machine's byte order."""
        page = f" page {start}" if stop == start + 1 else ""
        data = self._file.rows(name, self._subject(f"dataset '{name}'{page}"), start, stop)
        data = data.astype(data.dtype.newbyteorder("="), copy=False)  # torch takes no other byte order
        if name in REFERENCES:
            self._check_counts(name, data, "")
            data = self._without_black(data)
        return data

    def _without_black(self, frame: NDArray[Any]) -> NDArray[Any]:
        return without_black(frame, self._black_level, self._bit_depth)

    def _check_counts(self, name: str, frame: NDArray[Any], where: str) -> None:
        full_scale = 2**self._bit_depth - 1
        if int(frame.max()) > full_scale:
            raise RecordingError(
                self._subject(f"dataset '{name}'{where}"),
                f"a count of {frame.max()}",
                f"at most {full_scale}, since camera_bit_depth = {self._bit_depth}",
            )
        if not self._alignment_told and (unused := unused_low_bits(frame, self._bit_depth)):
            self._alignment_told = True
            warn(f"{self._subject(name)}: {describe(self._bit_depth, unused)}; right-aligned counts are wanted")


def _size(shape: tuple[int, int] | None) -> str:
    return "unknown" if shape is None else f"{shape[0]} x {shape[1]}"
