"""Measures what a recalibration in its own process costs reads, and what busy reads cost it.

    python -m analysis.hardware.recalibration --json FILE
    python -m analysis.hardware.recalibration --heal --load 0.6 --json FILE

The bench device with the shipped bundle has drifted a little. Its pages were photographed before, so that a read is
decoding alone. In turn: pages are read without a recalibration; a recalibration runs and nobody reads; pages are read
while one runs, without a pause or, at `--load 0.6`, so that reads take 60% of the time. With `--heal` six lost pages of
the device after a knock heal the model, while others read pages of before.
"""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import click
import numpy as np

from analysis.hardware.drifting import DriftingSource, direction, moved
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.state import Device
from lightpage.errors import LightpageError, LostPageError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.device.acquisition.source import SHOT_S, FrameSource, Shot
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.runtime.recalibration.healing import TOGETHER, LostPages
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import PagesToUse, Recalibrator
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.pages.reading import read_page

PAGES = 16
"""Different pages that are read, over and over."""

BEFORE = 40
"""Pages of a round that are read without a recalibration."""

KNOCKED_DEG = 0.03
"""By which the pipe turns: it costs a page a quarter of what it carries."""

SETTLED = 5
"""Pages after a start that are not timed: slopes are measured, threads and memory are made."""


class Photographed(FrameSource):
    """Pages that a source has shown before.

    Args:
        source: source that shows them once.
    """

    name = "photographed pages"

    def __init__(self, source: DriftingSource) -> None:
        self.levels, self.bit_depth = source.levels, source.bit_depth
        self.frame_shape, self.page_shape = source.frame_shape, source.page_shape
        self._shots = [source.shot(page=number) for number in range(PAGES)]
        self._references, self._next = source.references(), 0

    def shot(self, timeout_s: float = SHOT_S, page: int | None = None) -> Shot:
        """Return one of the pages."""
        if page is None:
            page, self._next = self._next, self._next + 1
        return self._shots[page % PAGES]

    def references(self) -> FramePair:
        """Return the source's reference frames."""
        return self._references


@dataclass(frozen=True)
class Taken:
    """Costs of a recalibration; not a number where it failed.

    Attributes:
        seconds: time from the call to the new model in service.
        worked_s: seconds of work in its own process.
        error: why it failed, if so.
    """

    seconds: float = np.nan
    worked_s: float = np.nan
    error: str = ""


def lost_pages(decoder: Decoder) -> LostPages:
    """Photograph pages of user data of the device after its pipe has turned by `KNOCKED_DEG`."""
    device = Device()
    knocked = device.with_settings([f"geometry.pipe_angle_deg={device.geometry.pipe_angle_deg + KNOCKED_DEG}"])
    source = DriftingSource(decoder, lambda moment: knocked, seed=4)
    pairs = tuple(source.shot(page=number).pair for number in range(TOGETHER))
    return LostPages(pairs, decoder.page_codec.code, references=source.references())


def recalibration(recalibrator: Recalibrator, lost: LostPages | None) -> Taken:
    """Run one to its end, by lost pages or by known ones."""
    pages = recalibrator.source_pages(2, [0, 1])
    if lost is not None:
        pages = PagesToUse("lost pages", lambda heard, caller: lost)
    start = time.perf_counter()
    try:
        *_, outcome = recalibrator.follow(pages, Caller())
    except LightpageError as error:
        return Taken(error=str(error))
    return Taken(time.perf_counter() - start, getattr(outcome, "seconds", 0.0))


def timed(plane: DataPlane, pause_s: float = 0.0) -> float:
    """Seconds of one read, its bytes too, behind which nobody reads for a while."""
    start = time.perf_counter()
    with suppress(LostPageError):  # a healed model is of the device after its knock
        read_page(plane, None, None, Caller(), user_data=True)
    taken = time.perf_counter() - start
    time.sleep(pause_s)
    return taken


@click.command()
@click.option("--rounds", default=3, show_default=True, type=click.IntRange(1), help="Rounds of all three.")
@click.option("--load", default=1.0, show_default=True, type=click.FloatRange(0.05, 1.0), help="Load of the reads.")
@click.option("--heal", is_flag=True, help="Recalibrate by lost pages.")
@click.option("--threads", type=click.IntRange(1), help="Threads of the service's inference; by default all cores.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(rounds: int, load: float, heal: bool, threads: int | None, json_path: Path | None) -> None:
    """Time reads with and without a recalibration beside them, and it with and without reads."""
    decoder = Decoder.load(bundle_path(DEFAULT), threads)
    source = Photographed(DriftingSource(decoder, lambda moment: moved(Device(), direction(1)), seed=3))
    lost = lost_pages(decoder) if heal else None
    alone, beside = list[float](), list[float]()
    idle, busy = list[Taken](), list[Taken]()
    for _ in track(range(rounds), "recalibration", unit="round"):
        plane = DataPlane(Models(decoder, loader=Loader(tracker_for)), source)
        recalibrator = Recalibrator(plane)
        pause_s = median(timed(plane) for _ in range(SETTLED)) * (1 / load - 1)
        alone += [timed(plane, pause_s) for _ in range(BEFORE)]
        idle.append(recalibration(recalibrator, lost))
        plane.models.rollback()
        for _ in range(SETTLED):
            timed(plane)
        with ThreadPoolExecutor(1) as pool:
            running = pool.submit(recalibration, recalibrator, lost)
            while not running.done():
                beside.append(timed(plane, pause_s))
        busy.append(running.result())
        recalibrator.close()
    idle_s, busy_s = median(one.seconds for one in idle), median(one.seconds for one in busy)
    figures: dict[str, float] = {
        "threads": threads or available_cpus(),
        "rounds": rounds,
        "load": load,
        "heal": heal,
        "read_s": median(alone),
        "read_s_beside_recalibration": median(beside),
        "read_ratio": median(beside) / median(alone),
        "read_ratio_p90": float(np.quantile(beside, 0.9) / np.quantile(alone, 0.9)),
        "read_ratio_p95": float(np.quantile(beside, 0.95) / np.quantile(alone, 0.95)),
        "read_s_longest_beside": max(beside),
        "read_s_longest": max(alone),
        "pages_during_a_recalibration": len(beside) / rounds,
        "recalibration_s_idle": idle_s,
        "recalibration_s_busy": busy_s,
        "recalibration_ratio": busy_s / idle_s,
        "in_its_process_s_idle": median(one.worked_s for one in idle),
        "in_its_process_s_busy": median(one.worked_s for one in busy),
    }
    for name, value in figures.items():
        click.echo(f"{name:<30} {value:.4g}")
    failed = [one.error for one in (*idle, *busy) if one.error]
    for error in failed:
        click.echo(f"failed: {error}")
    if json_path is not None:
        write_figures(json_path, {**figures, "failed": failed})


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.recalibration"))
