"""Reading a recording while its pages are decoded: disk, unpacking and transfer beside the arithmetic."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording


def frames_ahead(recording: Recording) -> Iterator[tuple[int, Future[FramePair]]]:
    """Every page's number and frames, in order; the next page is read while the caller works on one.

    One page is held beside the caller's, whatever a page weighs. `result()` raises what `Recording.frames` raises.
    """
    with ThreadPoolExecutor(1, "frames-ahead") as reader:
        following: Future[FramePair] | None = None
        for index in range(recording.pages):
            current = following or reader.submit(recording.frames, index)
            following = reader.submit(recording.frames, index + 1) if index + 1 < recording.pages else None
            yield index, current
