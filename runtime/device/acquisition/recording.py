"""Pages of a recording as a source."""

import threading
from pathlib import Path

from lightpage.device.profile import Profile
from lightpage.errors import NoSuchPageError, RecordingError, StorageError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.device.acquisition.source import SHOT_S, FrameSource, Shot


class RecordingSource(FrameSource):
    """Pages of a recording, over and over again: after the last page the next one is the first.

    Raises:
        RecordingError: not a sound recording.
    """

    def __init__(self, path: str | Path) -> None:
        self._recording = Recording.open(path)
        self._lock = threading.Lock()
        """Guards the position."""
        self._next = 0
        self.name = f"recording:{path}"
        self.profile = self._recording.header.own_profile()
        self.levels, self.bit_depth = self._recording.levels, self._recording.bit_depth
        self.frame_shape, self.page_shape = self._recording.frame_shape, self._recording.page_shape

    def check_against(self, profile: Profile) -> None:
        """Raise `RecordingError` unless the recording's shapes are those of `profile`."""
        self._recording.header.check_against(profile)

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        """Read page `page` of the file, or the next one.

        Raises:
            PageError: no such page.
            RecordingError, StorageError: it cannot be read.
        """
        recording = self._recording
        with self._lock:
            if page is None:
                page, self._next = self._next, (self._next + 1) % max(1, recording.pages)
        if not 0 <= page < recording.pages:
            raise NoSuchPageError(f"page of {self.name}", page, f"0..{recording.pages - 1}")
        try:
            pair, symbols = narrow(recording.frames(page), self.bit_depth), recording.symbols(page)
            return Shot(pair, page, symbols, recording.pilots(), recording.cameras.frame_infos(page))
        except (RecordingError, StorageError) as error:
            raise type(error)(f"page {page}, {error.subject}", error.got, error.expected) from None

    def page_count(self) -> int:
        """See `FrameSource.page_count`."""
        return self._recording.pages

    def references(self) -> FramePair:
        """The recording's reference frames."""
        return narrow(self._recording.references(), self.bit_depth)

    def close(self) -> None:
        """Close the file."""
        self._recording.close()
