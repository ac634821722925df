"""Finding the image again: offsets, walks, pages that are not this device's, and what it all costs.

    python -m analysis.tracking.image_search --out F

Every part is kept in F/figures.json as soon as it is measured, and not measured again. The pages come from the
project's own simulator; `--bundle B --recording R.h5` measures any other device's walking recording too. Two operating
points: the shipped decoder's device (full well 15,000 e-), and one with strong shot noise (32 e-), read by the kept
single pass of the comparison.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import click

from analysis.comparison.weight_store import TRAINED
from analysis.tracking.cost import full_size, speed
from analysis.tracking.figure import POINTS, draw
from analysis.tracking.first_pages import APART_PX, OFFSETS_PX, apart, offsets
from analysis.tracking.operating_points import NOISY, Figures, points
from analysis.tracking.tables import (
    tell_apart,
    tell_full_size,
    tell_gaps,
    tell_offsets,
    tell_sound,
    tell_speed,
    tell_walk,
    tell_wrong,
)
from analysis.tracking.walks import WAYS, gaps, sound_pages, walk
from analysis.tracking.wrong_pages import false_acquisitions
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFolder
from lightpage.errors import InvalidInputError
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path

WANTED_SHARE = 0.98
WALKED = 200
WRONG_PAGES = 100
"""Number of wrong pages of each kind."""
FULL_SIZE_PAGES = 3
REPEATS = 15


class FigureStore:
    """Figures that are kept as soon as they are measured."""

    def __init__(self, out: Path, options: Figures) -> None:
        self.path = out / "figures.json"
        self.figures: Figures = {"options": options}
        if self.path.exists():
            self.figures = json.loads(self.path.read_text())
            if self.figures.get("options") != options:
                raise InvalidInputError(f"--out {out}", "figures of other options", "the same ones, or another folder")

    def get(self, name: str, make: Callable[[], Figures]) -> Figures:
        """The figures of a part, measured if they are not there."""
        if name not in self.figures:
            self.figures[name] = make()
            inputs = {"bundle": bundle_path(DEFAULT), "weights": TRAINED / "bench" / NOISY}
            write_figures(self.path, self.figures, **inputs)
        part: Figures = self.figures[name]
        return part


@click.command()
@click.option("--seeds", default=10, show_default=True, type=click.IntRange(1), help="Seeds of every offset.")
@click.option("--pages", default=WALKED, show_default=True, type=click.IntRange(10), help="Pages of a walk.")
@click.option("--wrong", default=WRONG_PAGES, show_default=True, type=click.IntRange(2), help="Pages of each kind.")
@click.option("--point", "names", multiple=True, type=click.Choice(POINTS), default=POINTS, help="Only these.")
@click.option("--bundle", type=click.Path(path_type=Path, exists=True), help="Bundle of another device.")
@click.option("--recording", type=click.Path(path_type=Path, exists=True), help="Recording of that device, walking.")
@click.option("--out", required=True, type=OutputFolder())
def main(
    seeds: int, pages: int, wrong: int, names: tuple[str, ...], bundle: Path | None, recording: Path | None, out: Path
) -> None:
    """Measure how the image is found, followed and confirmed."""
    out.mkdir(parents=True, exist_ok=True)
    kept = FigureStore(out, {"seeds": seeds, "pages": pages, "wrong": wrong})
    for point in points(out, names):
        name = point.name
        rows = kept.get(f"{name}: offsets", partial(offsets, point, seeds))["rows"]
        click.echo(tell_offsets(name, rows, OFFSETS_PX, WANTED_SHARE))
        click.echo(tell_apart(name, kept.get(f"{name}: apart", partial(apart, point, seeds))["rows"], APART_PX))
        for way in WAYS:
            click.echo(tell_walk(f"{name}: {way}", kept.get(f"{name}: {way}", partial(walk, point, pages, way))))
        wrongs = kept.get(f"{name}: wrong pages", partial(false_acquisitions, point, wrong))
        click.echo(tell_wrong(name, wrongs["kinds"]))
        click.echo(tell_sound(name, kept.get(f"{name}: sound pages", partial(sound_pages, point, wrong))))
        click.echo(tell_speed(name, kept.get(f"{name}: speed", partial(speed, point, REPEATS))))
    click.echo(tell_full_size(kept.get("full size", partial(full_size, FULL_SIZE_PAGES))["rows"]))
    if bundle is not None and recording is not None:
        part = f"{recording.name} by {bundle.name}"
        click.echo(tell_gaps(part, kept.get(part, partial(gaps, bundle, recording))))
    if set(names) == set(POINTS):
        draw(kept.figures, out / "image_search.png")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.tracking.image_search"))
