"""A simulated week of one device that nobody looks after: it warms up, follows the day, and is knocked once.

    python -m analysis.hardware.week --pages 2000 --out FOLDER --json FILE

A page is read every five minutes, so 2,000 pages are a week. The bench device with the shipped bundle is read as a
service reads it, with tracker, monitor, self-calibration and flight recorder. All parts of its geometry drift at once.
Every page's figures are kept. An interrupted run goes on as a service does that was started anew, with the model of its
store.

With `--not-shown`, no known page is shown: pages of user data serve to recalibrate by, those that were read or those
that were lost. Pages are read in ranges then, whose lost ones are read once more after a recalibration.

With `--stroke -0.02 --axial 0.2`, the light drifts too: the modulator's stroke, and modulator and cameras out of focus.
The table then says what was true and what the model in service took for it. Focus needs a `--bundle` whose graphs know
axial places.

In a real week a recalibration ends before the next page is read, as with `--pages-during 0`. By default two pages are
read while one runs, and then its end is waited for.
"""

from __future__ import annotations

import logging
import sys
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from analysis.hardware.rows import Rows
from analysis.hardware.simulated_week import KNOCK_SHARE, PAGE_S, LightDrift, Week
from analysis.hardware.week_figure import draw
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.device.state import Device, load_device
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path

WANTED_SHARE = 0.95
"""Share of the AIR with the true table that a page should have."""

PARTS = 10
"""Parts of the week, each a line of its table."""

WORTH = 0.004
"""Share of the true table's AIR that an alarm must be about: half of what half of a page's margin is."""


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
        "pages_read_again": sum(len(row.get("again", ())) for row in rows),
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


def table_of(rows: Rows, pages: int) -> list[str]:
    """Return lines of a table: each part of the week, what was read then, and what was true and fitted at its end."""
    names = list(rows[-1]["true"])
    edges = np.linspace(0, pages, PARTS + 1).astype(int)
    lines = [
        f"| pages | AIR | of the true table's | recalibrations | lost | {' | '.join(names)} |",
        "|---" * (5 + len(names)) + "|",
    ]
    for begin, end in pairwise(edges):
        if part := [row for row in rows if begin <= row["page"] < end]:
            air, true = (fmean(row[name] for row in part) for name in ("air", "true_air"))
            done, lost = sum(row["ended"].count("done") for row in part), sum(bool(row["lost"]) for row in part)
            light = [f"{part[-1]['true'][name]:.4f}, {part[-1]['fitted'][name]:.4f}" for name in names]
            figures = [f"{begin}-{end - 1}", f"{air:.3f}", f"{air / true:.3f}", f"{done}", f"{lost}", *light]
            lines.append(f"| {' | '.join(figures)} |")
    return lines


@click.command()
@click.option("--pages", default=2000, show_default=True, type=click.IntRange(10), help="Pages of the week.")
@click.option("--stop-after", type=click.IntRange(1), help="End after so many pages of it; a later run goes on.")
@click.option(
    "--pages-during",
    default=2,
    show_default=True,
    type=click.IntRange(0),
    help="Pages that are read during a recalibration.",
)
@click.option("--true-every", default=1, show_default=True, type=click.IntRange(1), help="Pages from one true AIR on.")
@click.option("--threads", type=click.IntRange(1), help="Threads of an inference; by default all cores.")
@click.option("--bundle", default=DEFAULT, show_default=True, help="Bundle that the service begins with.")
@click.option("--device", type=click.Path(path_type=Path), help="True state (TOML) at the beginning.")
@click.option("--stroke", default=0.0, show_default=True, help="Change of the modulator's stroke, relative.")
@click.option("--axial", default=0.0, show_default=True, help="Change of all places along the axis, rad.")
@click.option("--shown/--not-shown", default=True, help="Show fully known pages, or recalibrate by user data alone.")
@click.option("--out", required=True, type=OutputFolder(), help="Folder of pages, models and frames.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(
    pages: int,
    stop_after: int | None,
    pages_during: int,
    true_every: int,
    threads: int | None,
    bundle: str,
    device: Path | None,
    stroke: float,
    axial: float,
    shown: bool,
    out: Path,
    json_path: Path | None,
) -> None:
    """Live through a week, and tell how it went."""
    out.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(level=logging.INFO, filename=out / "log", format="%(asctime)s %(levelname)s %(message)s")
    begun = Device() if device is None else load_device(device)
    light, path = LightDrift(stroke, axial), bundle_path(bundle)
    week = Week(out, pages, pages_during, threads, path, begun, light, true_every, shown)
    week.read_until(pages if stop_after is None else min(pages, stop_after))
    figures = figures_of(week.rows, pages)
    draw(week.rows, out / "week.png", int(KNOCK_SHARE * pages), PAGE_S)
    for name, value in figures.items():
        click.echo(f"{name:<36} {value}")
    for line in table_of(week.rows, pages):
        click.echo(line)
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.week"))
