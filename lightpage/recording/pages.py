"""Pages to write: the symbols that a modulator shows, in one HDF5 file, whole or not at all.

Root attributes: `format` = "lightpage-pages", `version` = 1, `levels` (M), `profile` (the nominal profile as TOML text)
and `code` (JSON text: what the pages hold). Dataset `symbols` uint8 [page, ny, nx], pilots included.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile, parse_profile
from lightpage.errors import RecordingError
from lightpage.failures import os_failure
from lightpage.files import move_into_place
from lightpage.page.levels import check_levels
from lightpage.page.symbols import check_symbols
from lightpage.recording.hdf5 import open_hdf5, read_attribute
from lightpage.recording.hdf_file import open_to_write
from lightpage.recording.stored import ArrayFile

FORMAT = "lightpage-pages"
VERSION = 1


class PagesWriter:
    """Writes pages to `<path>.partial`, and moves it to `path` when the `with` statement ends well.

    Args:
        path: final name.
        profile: nominal device.
        levels: M.
        code: what the pages hold, kept as JSON.

    Raises:
        RecordingError: the file cannot be written.
        PageError: a level count outside 2..256.
    """

    def __init__(self, path: Path, profile: Profile, levels: int, code: dict[str, Any]) -> None:
        check_levels(levels, f"pages {path}: levels")
        self.path, self._partial = path, path.with_name(path.name + ".partial")
        self._shape, self._levels = profile.page_shape, levels
        self._disk = open_to_write(self._partial, f"pages {self._partial}")
        self._file = h5py.File(self._disk, "w")  # type: ignore[arg-type]  # the stubs know only names
        attributes = {"format": FORMAT, "version": VERSION, "levels": levels, "profile": profile.to_toml()}
        for name, value in {**attributes, "code": json.dumps(code)}.items():
            self._file.attrs[name] = value
        self._symbols = self._file.create_dataset(
            "symbols", shape=(0, *self._shape), maxshape=(None, *self._shape), chunks=(1, *self._shape), dtype=np.uint8
        )

    def append(self, symbols: NDArray[np.uint8]) -> None:
        """Append pages [page, ny, nx].

        Raises:
            PageError: another shape, or a symbol beyond the levels.
            RecordingError: no room for them.
        """
        pages = check_symbols(symbols, self._shape, self._levels, f"pages {self.path}").reshape(-1, *self._shape)
        count = self._symbols.shape[0]
        self._symbols.resize(count + len(pages), axis=0)
        self._symbols[count:] = pages
        self._file.flush()
        try:
            self._disk.check()
        except OSError as error:
            raise os_failure(f"pages {self.path}", error, "room for them on the disk", RecordingError) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        try:  # the lock is held until the file has its name, or is gone
            if kind is not None:
                self._partial.unlink(missing_ok=True)
                return
            self._disk.check()
            move_into_place(self._partial, self.path)
        except OSError as failure:
            self._partial.unlink(missing_ok=True)
            raise os_failure(f"pages {self.path}", failure, "a file that can be completed", RecordingError) from None
        finally:
            self._disk.close()


class Pages:
    """A file of pages opened for reading and checked; use it in a `with` statement."""

    def __init__(self, file: h5py.File, path: Path) -> None:
        """Check `file`, which is closed with this; `Pages.open` is the usual way in.

        Raises:
            RecordingError: it holds no pages, or is inconsistent.
        """
        self.path, self._subject = path, f"pages {path}"
        self._file = ArrayFile(file, self._subject)
        try:
            self._check()
        except BaseException:
            self.close()
            raise

    def _check(self) -> None:
        for name, expected in (("format", FORMAT), ("version", VERSION)):
            if (got := self._file.attribute(name)) != expected:
                raise RecordingError(f"{self._subject}: attribute '{name}'", repr(got), repr(expected))
        levels = self._file.attribute("levels")
        check_levels(levels, f"{self._subject}: attribute 'levels'")
        self.levels = int(levels)
        subject, expected = f"{self._subject}: dataset 'symbols'", "uint8 (pages, ny, nx), at least one page"
        if (symbols := self._file.array("symbols")) is None:
            raise RecordingError(subject, "none", expected)
        shape, kind = symbols.shape, symbols.dtype
        if len(shape) != 3 or kind != np.uint8 or 0 in shape:
            raise RecordingError(subject, f"{kind} {shape}", expected)
        pages, rows, columns = shape
        self._shape = pages, rows, columns

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open and check a file of pages.

        Raises:
            RecordingError: missing, truncated, foreign or inconsistent.
        """
        return cls(open_hdf5(path, f"pages {path}"), path)

    @staticmethod
    def are_in(path: Path) -> bool:
        """Return whether an HDF5 file says that it holds pages to write.

        Raises:
            RecordingError: it is no HDF5 file, or cannot be read.
        """
        subject = f"file {path}"
        with open_hdf5(path, subject) as file:
            told = read_attribute(file, "format", subject)
            return isinstance(told, str) and told == FORMAT

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __len__(self) -> int:
        return self._shape[0]

    @property
    def code(self) -> str | None:
        """Return what the pages hold, JSON text, or None."""
        text = self._file.attribute("code")
        return text if isinstance(text, str) else None

    @property
    def page_shape(self) -> tuple[int, int]:
        """Symbols as (rows, columns)."""
        return self._shape[1:]

    def device(self, given: Profile | None) -> Profile:
        """The nominal profile of the pages: the one that was given, or else the file's own.

        Raises:
            RecordingError: there is none, or the pages have another shape.
            ProfileError: the file's own is needed, and cannot be read.
        """
        subject = f"{self._subject}: attribute 'profile'"
        if given is None:
            if not isinstance(text := self._file.attribute("profile"), str):
                raise RecordingError(subject, "none", "one, or --profile P")
            given = parse_profile(text, subject)
        self.check_against(given)
        return given

    def check_against(self, profile: Profile) -> None:
        """Check that the pages are for devices of this profile.

        Raises:
            RecordingError: pages of another shape.
        """
        if self.page_shape != profile.page_shape:
            expected = f"{profile.page_shape} (profile {profile.name})"
            raise RecordingError(f"pages {self.path}", f"pages of {self.page_shape} symbols", expected)

    def check(self) -> None:
        """Read every page once, before long work is begun on them.

        Raises:
            RecordingError: a page cannot be read, or holds a symbol beyond the levels; or `code` is no JSON object.
        """
        for _ in self:
            pass
        text = self._file.attribute("code")
        try:
            told = {} if text is None else json.loads(text)
        except (TypeError, ValueError):
            told = None
        if not isinstance(told, dict):
            raise RecordingError(f"pages {self.path}: attribute 'code'", repr(text)[:100], "a JSON object, or none")

    def __getitem__(self, page: int) -> NDArray[np.uint8]:
        """The symbols [ny, nx] of one page.

        Raises:
            RecordingError: they are no symbols of the levels.
            StorageError: its data cannot be read.
        """
        if not -len(self) <= page < len(self):
            raise IndexError(page)
        page %= len(self)
        symbols: NDArray[np.uint8] = self._file.page("symbols", page)
        if int(symbols.max()) >= self.levels:
            raise RecordingError(
                f"pages {self.path}: page {page}", f"a symbol of {symbols.max()}", f"0 to {self.levels - 1}"
            )
        return symbols

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        return (self[page] for page in range(len(self)))
