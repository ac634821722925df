"""States of recorded pages, found from their known symbols and kept page by page."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lightpage.files import replace_text
from lightpage.page.symbols import symbol_phases
from lightpage.progress import track
from lightpage.recording.reader import Recording
from lightpage.train.data.features import FeatureExtractor, PageState

_AT_ONCE = 16
"""Pages between two writes of the file."""


def page_states(
    path: Path, key: str, recording: Recording, extractor: FeatureExtractor, pages: list[int]
) -> tuple[list[PageState], float]:
    """States of the given pages, in order, and the seconds that finding them took, all stretches together.

    Args:
        path: file that keeps them; interrupted, the next call goes on with what is in it under the same key.
        key: everything that they depend on.
        recording: recording with symbols.
        extractor: extractor of the calibrated device; shift is followed from page to page.
        pages: numbers of the pages.
    """
    states, seconds = _kept(path, key)
    if len(states) >= len(pages):
        return states, seconds
    start = time.monotonic() - seconds
    done = len(states)
    for page in track(pages[done:], "piston and shift", total=len(pages), done=done):
        symbols = recording.symbols(page)
        assert symbols is not None
        shift = np.array(states[-1].shift_px) if states else np.zeros(2)
        phases = extractor.device.modulation.phase(symbol_phases(symbols, recording.levels))
        states.append(extractor.state(extractor.field(recording.frames(page)), phases, shift))
        if len(states) % _AT_ONCE == 0 or len(states) == len(pages):
            seconds = time.monotonic() - start
            kept = {"key": key, "seconds": seconds, "states": [asdict(state) for state in states]}
            replace_text(path, json.dumps(kept), "states of the pages")
    return states, seconds


def _kept(path: Path, key: str) -> tuple[list[PageState], float]:
    try:
        kept = json.loads(path.read_text("utf-8"))
        if kept["key"] == key:
            states = [PageState((s["shift_px"][0], s["shift_px"][1]), s["piston_rad"]) for s in kept["states"]]
            return states, float(kept["seconds"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return [], 0.0
