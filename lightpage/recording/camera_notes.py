"""What cameras said while they recorded, beside the frames; see the group `cameras` in `layout`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import RecordingError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import CAMERAS, DARK, HOT, LOSSES, SHOT_DATA, FrameInfo, LostShot
from lightpage.recording.stored import ArrayFile


@dataclass(frozen=True)
class CameraNotes:
    """What a recording has of its cameras; each is None, or empty, where it was not noted.

    Attributes:
        file: the recording.
        pages: that it has.
    """

    file: ArrayFile
    pages: int

    def check(self) -> None:
        """Check that what is noted can be read, without reading it.

        Raises:
            RecordingError: it is not whole.
        """
        for name in (*SHOT_DATA, *DARK, *HOT, LOSSES):
            self.file.array(name)

    def frame_infos(self, page: int) -> tuple[FrameInfo, FrameInfo] | None:
        """What the cameras said of a page's in-phase and quadrature frame.

        Raises:
            RecordingError: no such page, or the data cannot be read, or do not fit the frames.
        """
        known = [array for name in SHOT_DATA if (array := self.file.array(name)) is not None]
        if len(known) < len(SHOT_DATA):
            return None
        names = [self.file.attribute(name, group=CAMERAS) for name in ("serials", "pixel_formats")]
        shapes = {array.shape for array in known}
        if shapes != {(self.pages, 2)} or any(np.shape(name) != (2,) for name in names):
            subject, expected = (
                f"{self.file.subject}: group '{CAMERAS}'",
                f"({self.pages}, 2), and two serials and formats",
            )
            raise RecordingError(subject, f"shapes {sorted(shapes)}, {names}", expected)
        ids, device, host, exposures = (self.file.page(name, page).tolist() for name in SHOT_DATA)
        first, second = (
            FrameInfo(*values[:-1], None if np.isnan(values[-1]) else values[-1])
            for values in zip(map(str, names[0]), ids, device, host, map(str, names[1]), exposures, strict=True)
        )
        return first, second

    def dark_frames(self) -> FramePair | None:
        """What the cameras saw without light, as it was."""
        found = self._both(DARK)
        return None if found is None else FramePair(*found)

    def hot_pixels(self) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
        """Row and column [n, 2] of the pixels of each camera that were mended."""
        if (found := self._both(HOT)) is None:
            return None
        first, second = (pixels.astype(np.intp).reshape(-1, 2) for pixels in found)
        return first, second

    def losses(self) -> list[LostShot]:
        """Shots that gave no page.

        Raises:
            RecordingError: a note that cannot be read.
        """
        if (found := self.file.array(LOSSES)) is None:
            return []
        try:
            return [LostShot(**json.loads(text)) for text in self.file.rows(LOSSES)]
        except (TypeError, ValueError) as error:
            raise RecordingError(found.subject, error, "notes of lost shots") from None

    def _both(self, names: tuple[str, str]) -> list[NDArray[Any]] | None:
        """The arrays of both cameras, or None where one is missing."""
        return None if None in map(self.file.array, names) else [self.file.rows(name) for name in names]
