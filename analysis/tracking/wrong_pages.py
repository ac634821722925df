"""Pages that are not this device's: how many of them are given out."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from analysis.tracking.operating_points import LEVELS, WRONG_STREAM, Figures, Point
from lightpage.device.state import draw_device
from lightpage.errors import FrameError, UnconfirmedPageError
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.decoding.tracking import unconfirmed_page

DEVICES = 50
"""Others, over whose pages the pages of other devices are shared out."""


def wrong_pages(point: Point, pages: int) -> Iterator[tuple[str, FramePair]]:
    """Pages that must not be given out, with their kind."""
    devices = max(1, min(DEVICES, pages // 2))
    for number in range(devices):
        drawn = draw_device(np.random.default_rng([WRONG_STREAM, number]))
        sensor = point.device.sensor
        simulator = point.simulator(number, drawn.model_copy(update={"sensor": sensor}))
        for page in range(pages // devices):
            yield "another device", simulator.page(point.symbols(WRONG_STREAM, number, page))
    simulator, rng = point.simulator(WRONG_STREAM), np.random.default_rng(WRONG_STREAM)
    for page in range(pages):
        simulator.knock((float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1))))
        pair = simulator.page(point.symbols(WRONG_STREAM, page))
        yield "swapped frames", FramePair(pair.quadrature, pair.in_phase)
    references = simulator.references()
    for page in range(pages // 2):
        noisy = [
            np.clip(rng.normal(frame, 0.5 * frame.mean()), 0, 254).astype(frame.dtype)
            for frame in (references.in_phase, references.quadrature)
        ]
        yield "white noise", FramePair(*noisy)
        other = np.random.default_rng([WRONG_STREAM, 1, page]).integers(0, LEVELS, point.pilots.mask.shape, np.uint8)
        yield "pages without these pilots", point.simulator(page).page(other)


def false_acquisitions(point: Point, pages: int) -> Figures:
    """Pages of other devices, swapped frames and noise, each read by a decoder that was just started."""
    kinds: dict[str, dict[str, int]] = {}
    shares = []
    for kind, pair in track(wrong_pages(point, pages), f"{point.name}: wrong", unit="page", total=3 * pages):
        row = kinds.setdefault(kind, dict.fromkeys(("pages", "found", "given_out", "frames_refused", "unconfirmed"), 0))
        row["pages"] += 1
        row["found"] += point.search.find(pair, point.pilots).found
        try:
            shares.append(point.tracker.fork().decode(pair, LEVELS).check.share)
            row["given_out"] += 1
        except FrameError:
            row["frames_refused"] += 1
        except UnconfirmedPageError as error:
            shares += [unconfirmed_page(error).check.share]
            row["unconfirmed"] += 1
    return {"kinds": kinds, "shares": shares}
