"""Known pages: frame pairs of a recording with the phasors of the symbols that were written."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from optics.errors import RecordingError
from optics.frames import check_pair_light
from optics.page import symbol_phases
from optics.profile import Profile
from optics.recording import Recording
from optics.registration.calibrate import KnownPage


def known_pages(recording: Recording, profile: Profile, indices: Iterable[int]) -> list[KnownPage]:
    """Pages of a recording as registration takes them.

    Args:
        recording: open, with symbols.
        profile: the nominal device.
        indices: which pages.

    Raises:
        FrameError: a frame or reference that is black or saturated; it names recording, page and frame.
        RecordingError: no symbols, another shape than the profile's, no such page, or unreadable data.
    """
    recording.check_against(profile)
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
