"""Times the monitor's alarm: gradual drifts until pages are lost, and a quiet week without an alarm.

    python -m analysis.hardware.drifts --out FOLDER --json FILE

The bench device with the shipped bundle shows pages of user bytes and is read as a service reads it, without any
recalibration. Every page's figures are kept, so that an interrupted run goes on, and other thresholds can be tried
without a new simulation.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import click
import numpy as np

from analysis.hardware.drifting import DriftingSource, direction, moved
from analysis.hardware.rows import Rows, append_row, kept_rows
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.device.state import Device
from lightpage.errors import LightpageError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.monitor import Monitor, MonitorSettings, PageFigures
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.pages.reading import read_page

QUIET_BEFORE = 25
"""Pages of a drift before it begins: the monitor learns what is usual by 20."""

DRIFT_PAGES = 60
"""Pages in which a drift of one unit and a tenth, which is what a page's margin bears, passes: five hours at a page in
five minutes, a quarter of a daily cycle."""

MARGIN_UNITS = 1.1

LONGEST = 200
"""Pages of a drift at most: some directions cost less than others."""

GONE_AFTER = 3
"""Pages without bytes after which a drift ends."""

WANTED_PAGES = 5
"""Between the alarm and the first page whose margin is gone."""

WANTED_FALSE = 1
"""Alarms in a quiet week."""


@dataclass
class Recorder:
    """An observer that keeps the last page's figures."""

    figures: PageFigures
    last: dict[str, float]

    def observe(self, observation: Observation) -> None:
        """Take note of a page."""
        self.last = self.figures.of(observation)


def read(
    decoder: Decoder, source: DriftingSource, rows: Rows, pages: Iterable[int], keep: Callable[[dict[str, Any]], None]
) -> None:
    """Read pages as a service does, and keep the figures of each until `keep` raises `StopIteration`."""
    recorder = Recorder(PageFigures(), {})
    plane = DataPlane(Models(decoder, loader=Loader(tracker_for)), source, observers=[recorder])
    for number in pages:
        source.moment = float(number)
        lost = ""
        try:
            answer = read_page(plane, None, None, Caller(), user_data=True).answer
            if answer.user_data is not None and answer.user_data.loss is not None:
                lost = answer.user_data.loss.value
        except LightpageError as error:
            lost = type(error).__name__
        row = {"page": number, "lost": lost, "figures": recorder.last}
        rows.append(row)
        keep(row)
        if len(rows) >= GONE_AFTER and all(each["lost"] for each in rows[-GONE_AFTER:]):
            return


def drift_rows(decoder: Decoder, seed: int, path: Path) -> Rows:
    """The pages of one drift, from its file where it is whole."""
    rows = kept_rows(path)
    if rows and (rows[-1]["page"] == LONGEST or all(row["lost"] for row in rows[-GONE_AFTER:])):
        return rows
    path.unlink(missing_ok=True)
    rows, way = [], direction(seed) * MARGIN_UNITS / DRIFT_PAGES
    source = DriftingSource(decoder, lambda moment: moved(Device(), way * max(0.0, moment)), seed)
    pages = track(range(-QUIET_BEFORE, LONGEST + 1), f"drift {seed}")
    read(decoder, source, rows, pages, lambda row: append_row(path, row))
    return rows


def quiet_rows(decoder: Decoder, count: int, path: Path) -> Rows:
    """The pages of a quiet device; a run that was interrupted goes on as a service does that was started anew."""
    rows = kept_rows(path)
    source = DriftingSource(decoder, lambda moment: Device(), seed=99)
    source.skip(len(rows))
    pages = track(range(len(rows), count), "quiet", total=count, done=len(rows))
    read(decoder, source, rows, pages, lambda row: append_row(path, row))
    return rows[:count]


def alarms(rows: Rows, settings: MonitorSettings | None = None) -> list[tuple[int, tuple[str, ...]]]:
    """Pages at which a recalibration became due, with the reasons."""
    monitor, found, before = Monitor(settings), [], False
    for row in rows:
        monitor.follow("bundle", row["figures"])
        if monitor.due and not before:
            found.append((int(row["page"]), monitor.state().reasons))
        before = monitor.due
    return found


def judged(seed: int, rows: Rows) -> dict[str, Any]:
    """Return the page of the first alarm, the page at which the margin was gone, and how far the alarm came ahead."""
    told = alarms(rows)
    gone = next((int(row["page"]) for row in rows if row["page"] > 0 and row["lost"]), None)
    alarm, reasons = told[0] if told else (None, ())
    ahead = None if gone is None or alarm is None else gone - alarm
    return {"seed": seed, "alarm": alarm, "gone": gone, "pages_ahead": ahead, "reasons": list(reasons)}


@click.command()
@click.option("--drifts", default=20, show_default=True, type=click.IntRange(0), help="Directions of drift.")
@click.option("--quiet", default=2000, show_default=True, type=click.IntRange(0), help="Pages of a quiet device.")
@click.option("--threads", type=click.IntRange(1), help="Threads of an inference; by default all cores.")
@click.option("--out", required=True, type=OutputFolder(), help="Folder of every page's figures.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(drifts: int, quiet: int, threads: int | None, out: Path, json_path: Path | None) -> None:
    """Measure how long before the margin is gone the alarm comes, and how often it comes for nothing."""
    out.mkdir(parents=True, exist_ok=True)
    decoder = Decoder.load(bundle_path(DEFAULT), threads)
    found = [judged(seed, drift_rows(decoder, seed, out / f"drift-{seed}.jsonl")) for seed in range(drifts)]
    for each in found:
        click.echo(f"drift {each['seed']:3}: alarm {each['alarm']}, gone {each['gone']}: {'; '.join(each['reasons'])}")
    ahead = [each["pages_ahead"] for each in found if each["pages_ahead"] is not None]
    false = alarms(quiet_rows(decoder, quiet, out / "quiet.jsonl")) if quiet else []
    for page, reasons in false:
        click.echo(f"false alarm at page {page}: {'; '.join(reasons)}")
    figures = {
        "drifts": found,
        "pages_ahead_least": min(ahead, default=None),
        "pages_ahead_median": float(median(ahead)) if ahead else None,
        "drifts_in_time": int(np.sum([value >= WANTED_PAGES for value in ahead])),
        "quiet_pages": quiet,
        "false_alarms": len(false),
    }
    click.echo(
        f"{figures['drifts_in_time']} of {drifts} alarms at least {WANTED_PAGES} pages ahead "
        f"(least {figures['pages_ahead_least']}, median {figures['pages_ahead_median']}); "
        f"{len(false)} false alarms in {quiet} quiet pages (wanted: at most {WANTED_FALSE})"
    )
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.drifts"))
