"""What a recalibration in its own process costs reads, and what busy reads cost it.

    python -m analysis.hardware.recalibration --json FILE

The bench device with the shipped bundle has drifted a little. Its pages were photographed before, so that a read is
decoding alone. In turn: pages are read without a recalibration; a recalibration runs and nobody reads; pages are read
while one runs, without a pause or, at `--load 0.6`, so that reads take 60% of the time.
"""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np

from analysis.hardware.drifting import DriftingSource, direction, moved
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.state import Device
from lightpage.files import write_json
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from runtime.acquisition.source import SHOT_S, FrameSource, Shot
from runtime.bundle.shipped import DEFAULT, bundle_path
from runtime.decoding.decoder import Decoder
from runtime.decoding.image_tracker import tracker_for
from runtime.execution.cpus import available_cpus
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry

PAGES = 16
"""Different pages that are read, over and over."""

BEFORE = 40
"""Pages of a round that are read without a recalibration."""

SETTLED = 5
"""Pages after a start that are not timed: slopes are measured, threads and memory are made."""


class Photographed(FrameSource):
    """Pages that a source has shown before.

    Args:
        source: that shows them once.
    """

    name = "photographed pages"

    def __init__(self, source: DriftingSource) -> None:
        self.levels, self.bit_depth = source.levels, source.bit_depth
        self.frame_shape, self.page_shape = source.frame_shape, source.page_shape
        self._shots = [source.shot(page=number) for number in range(PAGES)]
        self._references, self._next = source.references(), 0

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        """One of the pages."""
        if page is None:
            page, self._next = self._next, self._next + 1
        return self._shots[page % PAGES]

    def references(self) -> FramePair:
        """Those of the source."""
        return self._references


@dataclass
class Recalibration:
    """A recalibration in the background.

    Attributes:
        seconds: that it took, from the call to the new model in service; None before its end.
        worked_s: of it, in its own process.
    """

    recalibrator: Recalibrator
    seconds: float | None = None
    worked_s: float = 0.0

    def start(self) -> threading.Thread:
        """Begin; the thread ends with it."""
        thread = threading.Thread(target=self._run, daemon=True)
        thread.start()
        return thread

    def _run(self) -> None:
        start = time.perf_counter()
        *_, outcome = self.recalibrator.from_source(2, [0, 1], Caller())
        self.seconds, self.worked_s = time.perf_counter() - start, getattr(outcome, "seconds", 0.0)


def timed(plane: DataPlane, pause_s: float = 0.0) -> float:
    """Seconds of one read, its bytes too, behind which nobody reads for a while."""
    start = time.perf_counter()
    plane.read_page(None, None, Caller(), user_data=True)
    taken = time.perf_counter() - start
    time.sleep(pause_s)
    return taken


@click.command()
@click.option("--rounds", default=3, show_default=True, type=click.IntRange(1), help="Of all three.")
@click.option("--load", default=1.0, show_default=True, type=click.FloatRange(0.05, 1.0), help="Of the reads.")
@click.option("--threads", type=click.IntRange(1), help="Threads of the service's inference; by default all cores.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(rounds: int, load: float, threads: int | None, json_path: Path | None) -> None:
    """Time reads with and without a recalibration beside them, and it with and without reads."""
    decoder = Decoder.load(bundle_path(DEFAULT), threads)
    source = Photographed(DriftingSource(decoder, lambda moment: moved(Device(), direction(1)), seed=3))
    alone, beside = list[float](), list[float]()
    idle, busy, worked_idle, worked_busy = list[float](), list[float](), list[float](), list[float]()
    for _ in track(range(rounds), "recalibration", unit="round"):
        plane = DataPlane(ModelRegistry(decoder, tracker_for), source)
        recalibrator = Recalibrator(plane)
        pause_s = median(timed(plane) for _ in range(SETTLED)) * (1 / load - 1)
        alone += [timed(plane, pause_s) for _ in range(BEFORE)]
        recalibration = Recalibration(recalibrator)
        recalibration.start().join()
        idle.append(recalibration.seconds or np.nan)
        worked_idle.append(recalibration.worked_s)
        plane.rollback()
        for _ in range(SETTLED):
            timed(plane)
        recalibration = Recalibration(recalibrator)
        thread = recalibration.start()
        while thread.is_alive():
            beside.append(timed(plane, pause_s))
        busy.append(recalibration.seconds or np.nan)
        worked_busy.append(recalibration.worked_s)
        recalibrator.close()
    figures: dict[str, Any] = {
        "threads": threads or available_cpus(),
        "rounds": rounds,
        "load": load,
        "read_s": median(alone),
        "read_s_beside_recalibration": median(beside),
        "read_ratio": median(beside) / median(alone),
        "read_ratio_p90": float(np.quantile(beside, 0.9) / np.quantile(alone, 0.9)),
        "read_ratio_p95": float(np.quantile(beside, 0.95) / np.quantile(alone, 0.95)),
        "read_s_longest_beside": max(beside),
        "read_s_longest": max(alone),
        "pages_during_a_recalibration": len(beside) / rounds,
        "recalibration_s_idle": median(idle),
        "recalibration_s_busy": median(busy),
        "recalibration_ratio": median(busy) / median(idle),
        "in_its_process_s_idle": median(worked_idle),
        "in_its_process_s_busy": median(worked_busy),
    }
    for name, value in figures.items():
        click.echo(f"{name:<30} {value:.4g}")
    if json_path is not None:
        write_json(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.recalibration"))
