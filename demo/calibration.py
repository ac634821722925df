"""Calibration of the demo's device by two known pages, in front of the user."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightpage.page.symbols import random_symbols
from lightpage.progress import Progress
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.archives.recordings.new_bundle import bundle_by_graphs, check_graphs
from lightpage.runtime.device.acquisition.page_store import PageStore
from lightpage.runtime.device.acquisition.source import FrameSource
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.from_nominal import calibrate_by_graphs

KNOWN_PAGES = 2
_LEVELS = 256
_VERSION = "demo-1"
_CALIBRATION_SHARE = 0.7
"""Share of the time until the device is calibrated; the rest measures its noise and chooses a code."""


def record_known_pages(source: FrameSource, decoder: Decoder, path: Path, seed: int) -> None:
    """Record pages of random known symbols, and the references.

    Args:
        source: source of the device's frames.
        decoder: decoder of any device of its profile.
        path: new recording.
        seed: seed of the symbols.
    """
    profile = decoder.bundle.profile
    symbols = random_symbols(profile, _LEVELS, KNOWN_PAGES, np.random.default_rng(seed))
    store = PageStore(profile)
    store.append(symbols, _LEVELS)
    source.show_pages(store)
    references = source.references()
    assert references is not None  # of a simulated device
    with RecordingWriter(path, profile, _LEVELS, decoder.bundle.manifest.camera_bit_depth, references) as writer:
        for page in range(KNOWN_PAGES):
            writer.append(symbols[page], source.shot(source.shot_s, page).pair)


def calibrated_decoder(decoder: Decoder, recording: Path, out: Path, progress: Progress) -> Decoder:
    """Calibrate a device from nominal, and write its bundle.

    Args:
        decoder: decoder of another device of the profile, whose graphs are used.
        recording: known pages of the device.
        out: new bundle.
        progress: called at the beginning of each step, and with its finished share.

    Raises:
        LightpageError: the pages do not calibrate the device, or the bundle holds a network.
    """
    with Recording.open(recording) as pages:
        check_graphs(decoder, pages)
        calibration = calibrate_by_graphs(
            decoder, pages, range(KNOWN_PAGES), lambda what, share: progress(what, _CALIBRATION_SHARE * share)
        )
        bundle_by_graphs(
            decoder,
            calibration,
            pages,
            out,
            version=_VERSION,
            progress=lambda what, share: progress(what, _CALIBRATION_SHARE + (1 - _CALIBRATION_SHARE) * share),
        )
    return Decoder.load(out)
