"""A simulated week of one device that nobody looks after: it warms up, follows the day, and is knocked once.

    python -m analysis.hardware.week --pages 2000 --out FOLDER --json FILE

A page is read every five minutes, so 2,000 pages are a week. The bench device with the shipped bundle is read as a
service reads it, with tracker, monitor, self-calibration and flight recorder. All parts of its geometry drift at once.
Every page's figures are kept. An interrupted run goes on as a service does that was started anew, with the model of its
store.

In the simulated week a recalibration ends before the next page is read. Here pages are read without a pause; while a
recalibration runs, `--pages-during` of them are read at most, and then its end is waited for.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, median
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from analysis.hardware.drifting import DriftingSource, TrueTable, direction, moved
from analysis.hardware.rows import Rows, append_row, kept_rows
from analysis.hardware.week_figure import draw
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.clock import Clock
from lightpage.device.state import Device
from lightpage.errors import FramesDisagreeError, LightpageError, LostPageError
from lightpage.files import write_json
from lightpage.progress import track
from lightpage.runtime.archives.recordings.coded_pages import air_bits
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.recalibration.outcome import RecalibrationOutcome
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator, Step
from lightpage.runtime.service.jobs.self_calibration import SelfCalibration, SelfCalibrationSettings
from lightpage.runtime.service.models.registry import ModelRegistry
from lightpage.runtime.service.models.store import ModelStore
from lightpage.runtime.service.monitoring.flight_recorder import FlightRecorder
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.pages.reading import read_page

PAGE_S = 300.0
"""Simulated time from one page to the next."""

DAY_PAGES = 288.0
DAILY_UNITS = 0.7
"""Amplitude of the daily cycle: 0.7 units cost 0.05 bit a symbol, and from evening to morning 0.2 bit, where a page has
0.13 to spare."""

WARM_UP_UNITS, WARM_UP_PAGES = 3.0, 144.0
"""Of the warm-up, 0.9 bit in all, and the pages (twelve hours) in which it falls to 1/e."""

KNOCK_SHARE = 0.5
"""Of the week, when somebody knocks against the table."""
KNOCK_PX, KNOCK_DEG = (2.0, -2.0), 0.02
"""Shift of the image on both cameras, and turn of the pipe."""

CALIBRATION_PAGES = (1_000_000, 1_000_001)
"""Numbers of the fully known pages, which nobody else reads."""

WANTED_SHARE = 0.95
"""Of the AIR with the true table that a page should have."""

WORTH = 0.004
"""Share of the true table's AIR that an alarm must be about: half of what half of a page's margin is."""


def state(moment: float, pages: int) -> Device:
    """The true device at a time of a week of `pages`, in pages: it was calibrated cold, at its beginning."""
    day = np.sin(2 * np.pi * moment / DAY_PAGES)
    warm_up = 1 - np.exp(-moment / WARM_UP_PAGES)
    device = moved(Device(), WARM_UP_UNITS * warm_up * direction(1) + DAILY_UNITS * day * direction(2))
    if moment < KNOCK_SHARE * pages:
        return device
    angle = device.geometry.pipe_angle_deg + KNOCK_DEG
    return device.model_copy(update={"geometry": device.geometry.model_copy(update={"pipe_angle_deg": angle})})


class SimulatedClock(Clock):
    """The seconds of a week that is simulated; what waits by it waits real ones."""

    def __init__(self, week: Week) -> None:
        self._week = week

    def now(self) -> float:
        """Return the simulated seconds."""
        return self._week.moment * PAGE_S


@dataclass
class Week:
    """A service and its device through a week.

    Args:
        out: where models, frames and rows are kept.
        pages: of the week.
        pages_during: that are read while a recalibration runs, at most.
        threads: of an inference.
    """

    out: Path
    pages: int
    pages_during: int
    threads: int | None
    rows: Rows = field(default_factory=list)
    moment: int = 0

    def read_until(self, end: int) -> None:
        """Read the pages before number `end` that are not kept yet."""
        path = self.out / "rows.jsonl"
        self.rows = kept_rows(path)
        base = Decoder.load(bundle_path(DEFAULT), self.threads)
        store = ModelStore(self.out / "models", base.bundle)
        registry = ModelRegistry(base, tracker_for)
        note = store.read()
        if (last := note.history[note.cursor]) is not None:
            registry.swap(Decoder.load(store.folder / last, self.threads))
        source = DriftingSource(base, lambda moment: state(moment, self.pages), seed=7)
        knock = int(KNOCK_SHARE * self.pages)
        if self.rows:
            source.skip(int(self.rows[-1]["shots"]))
            if self.rows[-1]["page"] >= knock:
                source.knock(KNOCK_PX)
        true_table, monitor = TrueTable(base), Monitor()
        with ExitStack() as stack:
            recorder = stack.enter_context(FlightRecorder(self.out / "flight", registry, monitor=monitor))
            plane = DataPlane(registry, source, store, observers=[recorder], monitor=monitor)
            watched = Watched(plane)
            stack.callback(watched.close)
            settings = SelfCalibrationSettings(CALIBRATION_PAGES, busy_s=0.05)
            stack.enter_context(SelfCalibration(plane, monitor, watched, settings, SimulatedClock(self)))
            begun = len(self.rows)
            numbers = track(range(begun, end), "week", total=end, done=begun)
            for number in numbers:
                self.moment = number
                source.moment = float(number)
                if number == knock:
                    source.knock(KNOCK_PX)
                row = self._read(number, plane, monitor, source, true_table)
                row |= {"restarted": number == begun > 0, "during": watched.running, "ended": watched.ended()}
                self.rows.append(row)
                append_row(path, row)
                watched.settle(monitor, self.pages_during)

    def _read(
        self, number: int, plane: DataPlane, monitor: Monitor, source: DriftingSource, true_table: TrueTable
    ) -> dict[str, Any]:
        """Read a page; what it was like, and what it would have been like with the true table."""
        row: dict[str, Any] = {"page": number, "air": 0.0, "margin": None, "shift_px": None, "failed": False}
        before = plane.registry.current.version
        try:
            found = read_page(plane, number, None, Caller(), user_data=True)
        except LightpageError as error:
            disagree = isinstance(error.__cause__, FramesDisagreeError)
            failed = not (isinstance(error, LostPageError) or disagree)
            row |= {"lost": type(error).__name__, "failed": failed, "version": before}
        else:
            answer, symbols = found.answer, source.truth(number).symbols
            data, page = answer.user_data, answer.page
            assert data is not None  # asked for
            row |= {
                "air": air_bits(page, symbols, true_table.data, source.levels),
                "margin": data.margin_bits,
                "lost": "" if data.loss is None else data.loss.value,
                "version": answer.model_version,
                "shift_px": None if page.image is None else [page.image.shift_x_px, page.image.shift_y_px],
            }
        row |= {
            "true_air": true_table.air(source.truth(number), source.levels),
            "due": monitor.due,
            "reasons": list(monitor.state().reasons),
            "shots": source.shots,
        }
        return row


class Watched(Recalibrator):
    """A recalibrator of which is known when it runs and how it ended.

    Args:
        plane: of the service.
    """

    def __init__(self, plane: DataPlane) -> None:
        super().__init__(plane)
        self._ends = list[str]()
        self._lock = threading.Lock()
        self.running, self._pages = False, 0

    def from_source(self, count: int, pages: Sequence[int], caller: Caller) -> Iterator[Step | RecalibrationOutcome]:
        """See `Recalibrator`."""
        self.running, self._pages, end = True, 0, "done"
        try:
            yield from super().from_source(count, pages, caller)
        except Exception as error:
            end = type(error).__name__
            raise
        finally:
            self.running = False
            with self._lock:
                self._ends.append(end)

    def ended(self) -> list[str]:
        """Return how recalibrations ended since the last call."""
        with self._lock:
            ends, self._ends = self._ends, []
        return ends

    def settle(self, monitor: Monitor, pages: int) -> None:
        """After a page: give a recalibration that is due time to begin, and wait for it after `pages` pages."""
        if monitor.due and not self.running:
            _wait(lambda: self.running or not monitor.due, 0.5)
        if self.running:
            self._pages += 1
            if self._pages > pages:
                _wait(lambda: not self.running, 600.0)


def _wait(until: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not until() and time.monotonic() < end:
        time.sleep(0.02)


def figures_of(rows: Rows, pages: int) -> dict[str, Any]:
    """Return the figures of the week."""
    air = np.array([row["air"] for row in rows])
    share = air / np.array([row["true_air"] for row in rows])
    ends = [end for row in rows for end in row["ended"]]
    knock = int(KNOCK_SHARE * pages)
    after = [row["page"] for row in rows if row["page"] > knock and "done" in row["ended"]]
    apart = np.array([knock <= row["page"] <= (after[0] if after else pages) for row in rows])
    due = [row["page"] for row, before in zip(rows[1:], rows, strict=False) if row["due"] and not before["due"]]
    return {
        "pages": len(rows),
        "share_of_pages_wanted": float(np.mean(share >= WANTED_SHARE)),
        "share_of_pages_wanted_but_for_the_knock": float(np.mean(share[~apart] >= WANTED_SHARE)),
        "wanted_share_of_true_air": WANTED_SHARE,
        "air_mean": fmean(air),
        "true_air_mean": fmean(row["true_air"] for row in rows),
        "pages_lost": sum(bool(row["lost"]) for row in rows),
        "pages_lost_but_for_the_knock": sum(
            bool(row["lost"]) for row, knocked in zip(rows, apart, strict=True) if not knocked
        ),
        "human_steps": 0,
        "restarts": sum(row["restarted"] for row in rows),
        "failed_requests": sum(row["failed"] for row in rows),
        "recalibrations": ends.count("done"),
        "refused_or_failed": len(ends) - ends.count("done"),
        "pages_from_knock_to_recalibrated": after[0] - knock if after else None,
        "pages_during_a_recalibration": _during(rows),
        "alarms": len(due),
        "false_alarms": false_alarms(rows, due),
    }


def _during(rows: Rows) -> float | None:
    """Pages read while a recalibration ran, median over all."""
    runs, count = list[int](), 0
    for row in rows:
        count += bool(row["during"])
        if row["ended"]:
            runs.append(count)
            count = 0
    return float(median(runs)) if runs else None


def false_alarms(rows: Rows, due: list[int]) -> int:
    """Alarms where the last ten pages had lost nothing worth a recalibration."""
    share: NDArray[np.float64] = np.array([row["air"] / row["true_air"] for row in rows])
    return sum(float(np.mean(share[max(0, page - 9) : page + 1])) > 1 - WORTH for page in due)


@click.command()
@click.option("--pages", default=2000, show_default=True, type=click.IntRange(10), help="Of the week.")
@click.option("--stop-after", type=click.IntRange(1), help="End after so many pages of it; a later run goes on.")
@click.option("--pages-during", default=2, show_default=True, type=click.IntRange(0), help="Of a recalibration.")
@click.option("--threads", type=click.IntRange(1), help="Threads of an inference; by default all cores.")
@click.option("--out", required=True, type=OutputFolder(), help="Where pages, models and frames are kept.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    pages: int, stop_after: int | None, pages_during: int, threads: int | None, out: Path, json_path: Path | None
) -> None:
    """Live through a week, and tell how it went."""
    out.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(level=logging.INFO, filename=out / "log", format="%(asctime)s %(levelname)s %(message)s")
    week = Week(out, pages, pages_during, threads)
    week.read_until(pages if stop_after is None else min(pages, stop_after))
    figures = figures_of(week.rows, pages)
    draw(week.rows, out / "week.png", int(KNOCK_SHARE * pages), PAGE_S)
    for name, value in figures.items():
        click.echo(f"{name:<36} {value}")
    if json_path is not None:
        write_json(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.week"))
