"""Finds the geometry of a drive that a model was never calibrated for, by pages of user data written for its make."""

from dataclasses import replace

import numpy as np

from lightpage.calibration.likelihood.table import FLAT_FIELD
from lightpage.calibration.parameters import as_dict
from lightpage.calibration.unknown_pages.device_search import find_device
from lightpage.errors import CalibrationError, RecalibrationRefusedError, raised_as
from lightpage.page.modulation import NOMINAL
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import symbol_phases
from lightpage.progress import Progress
from lightpage.recording.layout import hash_frames
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.healing import LostPages
from lightpage.runtime.recalibration.recalibration import refitted_bundle
from lightpage.runtime.recalibration.refit import blemishes_of, traced

MOST_PAGES = 8
"""Pages at most that a device is found by."""


def of_other_device(decoder: Decoder, pages: LostPages, progress: Progress) -> Decoder:
    """The model of a device with the geometry of another one of its profile, as that one's pilots show it.

    It is near enough for a healing to go on from. Its bundle lies in memory; its calibration tells no coherence, which
    fits that follow would have to reach.

    Args:
        decoder: calibrated for some device; its geometry and modulator are left aside.
        pages: pages of the other device; `MOST_PAGES` are looked at, the first ones; repeated ones count once.
        progress: told of every step. It may raise to stop the work.

    Raises:
        RecalibrationRefusedError: their pilots are not found.
        BundleError: the bundle holds a geometry that cannot be fitted.
    """
    bundle, levels = decoder.bundle, pages.code.levels
    distinct = {hash_frames(pair): pair for pair in pages.pairs[:MOST_PAGES]}
    with raised_as(RecalibrationRefusedError, CalibrationError):
        twin, blemishes = OnnxTwin(bundle), blemishes_of(decoder, pages.references)
        pilots = Pilots(bundle.pilot_mask, symbol_phases(bundle.written_pilots(levels), levels))
        pairs = [blemishes.corrected(pair) for pair in distinct.values()]
        found = find_device(twin, bundle.profile, pairs, blemishes.references, pilots, progress)
        start = bundle.calibration.model_copy(
            update={
                "parameters": as_dict(found.parameters),
                "turn_rad": found.turn_rad,
                "modulation": NOMINAL.as_dict(),
                "coherence_after": 0.0,
                "coherence_at_first": None,
                "goodness": None,
                "reading": None,
                "calibrated_pages": tuple(distinct),
            }
        )
        result = traced(decoder, twin, blemishes.references, start, gains=blemishes.gains)
        without_flat_field = decoder.taken({FLAT_FIELD: np.zeros(bundle.profile.page_shape, np.float32)})
        return decoder.of_bundle(refitted_bundle(bundle, replace(result, table=result.table | without_flat_field)))
