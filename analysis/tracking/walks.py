"""Pages read one after the other: a walk of the image, the device as it is, another device's recording."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from statistics import fmean

import numpy as np

from analysis.tracking.operating_points import LEVELS, WALKS_STREAM, Figures, Point, share_of
from lightpage.errors import UnconfirmedPageError
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from lightpage.progress import track
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import evaluate, was_seen
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.simulator.simulator import Simulator

WAYS = ("random walk", "straight walk, reference stays")
WALK_PX = 0.12
"""Length of a step from page to page, camera pixels."""


def walk(point: Point, pages: int, way: str) -> Figures:
    """A walk without a gap, read page by page."""
    tracker = point.tracker.fork()
    simulator = point.simulator(WALKS_STREAM, reference_stays=way.endswith("reference stays"))
    rng, rows, place = np.random.default_rng(WALKS_STREAM), [], np.zeros(2)
    for page in track(range(pages), f"{point.name}: {way}", unit="page"):
        step = np.array([0.0, WALK_PX]) if way.startswith("straight") else rng.normal(0, WALK_PX, 2)
        simulator.knock((float(step[0]), float(step[1])))
        place = place + step
        written = point.symbols(WALKS_STREAM, page)
        air, told = point.air(tracker, simulator.page(written), written)
        rows.append({"place_px": place.tolist(), "air": air, **told})
    rates = [row["air"] for row in rows]
    worst, last = (share_of(air, rates[0]) for air in (min(rates), fmean(rates[-10:])))
    return {"rows": rows, "first": rates[0], "worst_share": worst, "last_share": last}


def sound_pages(point: Point, pages: int) -> Figures:
    """Pages of the device as it is, read one after the other: how often one is not given out, or a re-fit is asked."""
    simulator = Simulator(point.decoder.bundle.profile, point.device, LEVELS, WALKS_STREAM + 1)
    tracker, shares, lost, due = point.tracker.fork(), [], 0, 0
    for page in track(range(pages), f"{point.name}: sound pages", unit="page"):
        try:
            found = tracker.decode(simulator.page(point.symbols(WALKS_STREAM, 1, page)), LEVELS)
        except UnconfirmedPageError:
            lost += 1
        else:
            shares.append(found.check.share)
            due += found.check.recalibration_due
    return {"pages": pages, "unconfirmed": lost, "recalibration_due": due, "shares": shares}


def gaps(bundle: Path, recording: Path) -> Figures:
    """Decode another device's recording, all pages in order and each by a decoder that was just started."""
    decoder = Decoder.load(bundle)
    tracker, rows = tracker_for(decoder), []
    with Recording.open(recording) as pages:
        in_order = evaluate(decoder, pages, tracker.fork()).air_per_page
        mask = decoder.bundle.pilot_mask if (own := pages.pilots()) is None else own
        for page in track(range(pages.pages), str(recording), unit="page"):
            frames, symbols = pages.frames(page), pages.symbols(page)
            if symbols is None or was_seen(decoder, frames):
                continue
            known = Pilots.of_symbols(mask, symbols, pages.levels)
            air, told = 0.0, Figures()
            with suppress(UnconfirmedPageError):
                decoded = tracker.fork().decode(narrow(frames, pages.bit_depth), pages.levels, known)
                figures = measure(decoded.phase[~mask], decoded.concentration[~mask], symbols[~mask], pages.levels)
                assert decoded.image is not None
                air = figures.air_bits_per_symbol
                told = {"shift_px": [decoded.image.shift_x_px, decoded.image.shift_y_px]}
            rows.append({"page": page, "air": air, **told})
    return {"in_order": list(in_order), "after_a_gap": rows}
