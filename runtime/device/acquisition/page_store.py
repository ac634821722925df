"""Pages that a source's modulator shows: rows of a file, followed by pages that a caller has uploaded."""

import threading

import numpy as np
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from lightpage.errors import InvalidInputError, LimitError, NoSuchPageError
from lightpage.page.symbols import check_symbols
from lightpage.recording.pages import Pages

UPLOADED_BYTES = 256 << 20
"""Most bytes of uploaded pages: 50,000 bench pages, 800 full-size pages of 2x2 pixels. They lie in memory."""


class PageStore:
    """Pages by number. Its methods may be called from many threads.

    Args:
        profile: nominal device.
        written: pages of a file, or None; it is closed with the store.
        levels: M, 2 to 256, where there is no file to say it; None leaves it to the first upload.

    Attributes:
        levels: M of all pages; None before it is known.
        most_bytes: largest size of uploaded pages; more are refused.

    Raises:
        RecordingError: pages for another profile.
    """

    def __init__(self, profile: Profile, written: Pages | None = None, levels: int | None = None) -> None:
        if written is not None:
            written.check_against(profile)
            levels = written.levels
        self._shape, self._written, self.levels = profile.page_shape, written, levels
        self._in_file = 0 if written is None else len(written)
        self.most_bytes = UPLOADED_BYTES
        self._uploaded: list[NDArray[np.uint8]] = []
        self._lock = threading.Lock()
        """Guards all of it; the file is read under it too."""

    @property
    def code(self) -> str | None:
        """Return what the pages of the file hold, JSON text, or None."""
        with self._lock:
            return None if self._written is None else self._written.code

    def __len__(self) -> int:
        with self._lock:
            return self._in_file + len(self._uploaded)

    def __getitem__(self, page: int) -> NDArray[np.uint8]:
        """The symbols [ny, nx] of a page.

        Raises:
            PageError: no such page.
            RecordingError: it cannot be read.
        """
        with self._lock:
            count = self._in_file + len(self._uploaded)
            if not 0 <= page < count:
                expected = f"0..{count - 1}" if count else "a page: none was given or uploaded"
                raise NoSuchPageError("page to show", page, expected)
            if self._written is not None and page < self._in_file:
                return self._written[page]
            return self._uploaded[page - self._in_file]

    def append(self, symbols: NDArray[np.uint8], levels: int) -> int:
        """Take in pages [page, ny, nx] of M levels behind those that are there; returns the first one's number.

        Raises:
            PageError: another shape, or symbols beyond the levels.
            InvalidInputError: other levels than the pages that are there.
            LimitError: more than the store holds.
        """
        pages = check_symbols(symbols, self._shape, levels, "uploaded pages").reshape(-1, *self._shape)
        with self._lock:
            if self.levels is not None and levels != self.levels:
                raise InvalidInputError("levels of uploaded pages", levels, f"{self.levels}, as the pages before have")
            held = sum(page.nbytes for page in self._uploaded) + pages.nbytes
            if held > self.most_bytes:
                raise LimitError("uploaded pages", f"{held} bytes with those held", f"at most {self.most_bytes}")
            first = self._in_file + len(self._uploaded)
            self.levels = levels
            self._uploaded.extend(page.copy() for page in pages)
            return first

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            if self._written is not None:
                self._written.close()
