"""The first page that a decoder reads after it was started, its image off or its cameras apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.tracking.operating_points import OFFSETS_STREAM, Figures, Point, share_of
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.simulator.simulator import Simulator

OFFSETS_PX = (0.5, 1.0, 2.0, 4.0, 8.0, 12.0)
APART_PX = (0.1, 0.25, 0.5, 1.0, 2.0)


def offsets(point: Point, seeds: int) -> Figures:
    """The first page of a decoder that was just started, its image off by so much in any direction."""
    rows = []
    for seed in track(range(seeds), f"{point.name}: offsets", unit="seed"):
        rng = np.random.default_rng([OFFSETS_STREAM, seed])
        written = [point.symbols(OFFSETS_STREAM, seed, page) for page in range(2)]
        settled = point.tracker.fork()
        simulators = {stays: point.simulator(seed, reference_stays=stays) for stays in (False, True)}
        point.air(settled, simulators[False].page(written[0]), written[0])
        tracked, told = point.air(settled, simulators[False].page(written[1]), written[1])
        for offset in OFFSETS_PX:
            for stays in (False, True):
                way = rng.uniform(0, 2 * np.pi)
                by = offset * np.cos(way), offset * np.sin(way)
                started = point.tracker.fork()
                first, second = knocked(simulators[stays], by, written[1])
                air, found = point.air(started, first, written[1])
                then, _ = point.air(started, second, written[1])
                row = {"seed": seed, "offset_px": offset, "by_px": by, "reference_stays": stays, "air": air}
                row |= {"share_of_tracked": share_of(air, tracked), "next_share": share_of(then, tracked)}
                rows.append(row | {"extra_seconds": found["seconds"] - told["seconds"], **found})
    return {"rows": rows}


def knocked(
    simulator: Simulator, by_px: tuple[float, float], symbols: NDArray[np.uint8]
) -> tuple[FramePair, FramePair]:
    """A page twice, whose image lies off; the next one lies where it was."""
    simulator.knock(by_px)
    pairs = simulator.page(symbols), simulator.page(symbols)
    simulator.knock((-by_px[0], -by_px[1]))
    return pairs


def apart(point: Point, seeds: int) -> Figures:
    """Measure first pages of devices whose quadrature camera alone has moved."""
    rows, pose = [], point.device.quadrature_camera
    for seed in track(range(seeds), f"{point.name}: cameras apart", unit="seed"):
        rng = np.random.default_rng([OFFSETS_STREAM, 1, seed])
        written = point.symbols(OFFSETS_STREAM, seed, 1)
        tracked, _ = point.air(point.tracker.fork(), point.simulator(seed).page(written), written)
        for offset in APART_PX:
            way = rng.uniform(0, 2 * np.pi)
            moved = pose.model_copy(
                update={
                    "shift_x_px": pose.shift_x_px + offset * np.cos(way),
                    "shift_y_px": pose.shift_y_px + offset * np.sin(way),
                }
            )
            device = point.device.model_copy(update={"quadrature_camera": moved})
            air, told = point.air(point.tracker.fork(), point.simulator(seed, device).page(written), written)
            rows.append({"seed": seed, "offset_px": offset, "share_of_tracked": share_of(air, tracked), **told})
    return {"rows": rows}
