"""Known pages: frame pairs of a recording with the phasors of the symbols that were written."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice

import numpy as np

from lightpage.calibration.calibrate import KnownPage
from lightpage.device.profile import Profile
from lightpage.errors import FrameError, RecordingError
from lightpage.page.symbols import symbol_phases
from lightpage.recording.exposure import check_pair_light
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.pixels.blemishes import Blemishes
from lightpage.recording.reader import Recording


def lit_pages(recording: Recording, left_out: Callable[[str], None]) -> Iterator[tuple[int, FramePair]]:
    """Pages whose frames show light, in order, with their frames; `left_out` is told of each other as it is met.

    Raises:
        RecordingError: unreadable data.
    """
    for page in range(recording.pages):
        pair = recording.frames(page)
        try:
            check_pair_light(f"recording {recording.path}, page {page}, ", pair, recording.bit_depth)
        except FrameError as error:
            left_out(f"left out: {error}")
        else:
            yield page, pair


def first_lit_pages(recording: Recording, count: int, left_out: Callable[[str], None]) -> list[int]:
    """The first so many pages whose frames show light.

    Raises:
        RecordingError: there are fewer, or unreadable data.
    """
    found = [page for page, _ in islice(lit_pages(recording, left_out), count)]
    if len(found) < count:
        dark = recording.pages - len(found)
        came = f"{recording.pages} pages" + (f", {dark} of them black or saturated" if dark else "")
        raise RecordingError(f"recording {recording.path}", came, f"at least {count} that show light (--pages)")
    return found


def known_pages(recording: Recording, profile: Profile, indices: Iterable[int]) -> list[KnownPage]:
    """Pages of a recording as registration takes them.

    Args:
        recording: open, with symbols.
        profile: the nominal device.
        indices: numbers of the pages.

    Raises:
        FrameError: a frame or reference that is black or saturated; it names recording, page and frame.
        RecordingError: no symbols, another shape than the profile's, no such page, or unreadable data.
    """
    recording.header.check_against(profile)
    check_pair_light(f"recording {recording.path}, reference, ", recording.references(), recording.bit_depth)
    pages = []
    for index in indices:
        symbols = recording.symbols(index)
        if symbols is None:
            raise RecordingError(
                f"recording {recording.path}: dataset 'symbols'",
                "none",
                "the symbols that were written, to calibrate by",
            )
        pair = recording.frames(index)
        check_pair_light(f"recording {recording.path}, page {index}, ", pair, recording.bit_depth)
        pages.append(KnownPage(pair, np.exp(1j * symbol_phases(symbols, recording.levels))))
    return pages


def without_blemishes(pages: Sequence[KnownPage], blemishes: Blemishes) -> list[KnownPage]:
    """Known pages without the blemishes of their frames."""
    return [KnownPage(blemishes.corrected(page.pair), page.symbols) for page in pages]
