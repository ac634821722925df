"""Archives to measure on: bench pages, of which some are simulated and the others are these with new noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from analysis.comparison.data_set import data_set_of
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.page.symbols import random_symbols
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from lightpage.simulator.simulator import Simulator

LEVELS = 16
_NOISE_COUNTS = 2.0
"""Standard deviation of the noise that tells two pages of one field apart, counts."""


def archive(folder: Path, pages: int, fields: int, seed: int, kept: Path | None = None) -> Path:
    """A recording of a device with known symbols; made once.

    Args:
        folder: folder that it goes into.
        pages: number of its pages.
        fields: how many of them are simulated.
        seed: seed of symbols and noise.
        kept: folder of the data set whose device it is; None for the shipped bundle's.
    """
    simulated, out = folder / "fields.h5", folder / "archive.h5"
    profile, device = (load_profile("bench"), Device()) if kept is None else data_set_of(kept)[:2]
    bits = device.sensor.bit_depth
    if not simulated.exists():
        simulator = Simulator(profile, device, LEVELS, seed)
        symbols = random_symbols(profile, LEVELS, fields, np.random.default_rng(seed))
        with RecordingWriter(simulated, profile, LEVELS, bits, simulator.references(), resume=True) as writer:
            for number in track(range(writer.pages, fields), "simulate", total=fields, done=writer.pages):
                writer.append(symbols[number], simulator.page(symbols[number]))
    if not out.exists():
        rng = np.random.default_rng(seed)
        with (
            Recording.open(simulated) as known,
            RecordingWriter(out, profile, LEVELS, bits, known.references()) as writer,
        ):
            for number in track(range(pages), "new noise", total=pages):
                pair, written = known.shown(number % fields)
                writer.append(written, _noisy(pair, bits, rng))
    return out


def _noisy(pair: FramePair, bits: int, rng: np.random.Generator) -> FramePair:
    frames = []
    for frame in (pair.in_phase, pair.quadrature):
        counts = frame + rng.normal(0.0, _NOISE_COUNTS, frame.shape)
        frames.append(np.clip(np.rint(counts), 0, 2**bits - 1).astype(frame.dtype))
    return FramePair(*frames)
