"""Cameras and serial line are unplugged and plugged in again: how soon pages are read after that, and what is lost.

    python -m analysis.hardware.plugs --times 30 --json runs/plugs.json

A page that is asked for while something is unplugged waits for it, for as long as its caller does. Runs in a private
network.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from analysis.hardware.faulty_chain import Stage, numbers_shown, small_cameras, source_of
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.errors import LostShotError, SourceError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.device.acquisition.camera_source import CameraSource
from lightpage.virtual_device.namespace import go_on_inside

AWAY_S = 1.0
_PATIENCE_S = 30.0
_ATTEMPTS = 10
TOLERANCE_S = 0.03
REPEATS = 3
"""Further shots of a page: a busy machine delays an edge now and then, which is not what is counted."""


def steady(source: CameraSource, page: int) -> None:
    """Read a page, in some attempts: what is lost before anything is unplugged is not what is counted."""
    for _ in range(_ATTEMPTS):
        try:
            source.shot(_PATIENCE_S, page)
            return
        except LostShotError:
            continue
    raise SourceError("chain", f"{_ATTEMPTS} lost shots in a row", "one that reads pages while all is plugged in")


def unplugged(
    source: CameraSource, stage: Stage, unplug: Callable[[], object], plug: Callable[[], object], times: int, what: str
) -> dict[str, Any]:
    """Unplug something so many times; pages are asked for all the while."""
    back: list[float] = []
    lost, wrong, page = Counter[str](), 0, 0
    for _ in track(range(times), what, total=times):
        steady(source, page)
        plugged = [0.0]

        def again(at: list[float] = plugged) -> None:
            plug()
            at[0] = time.monotonic()

        unplug()
        timer = threading.Timer(AWAY_S, again)
        timer.start()
        page += 1
        try:
            pair = source.shot(_PATIENCE_S, page).pair
        except LostShotError as error:
            lost[error.reason.value] += 1
        else:
            wrong += numbers_shown(pair) != [page, page]
            timer.join()
            back.append(time.monotonic() - plugged[0])
        timer.join()
        page += 1
    return {
        "times": times,
        "pages_lost": lost.total(),
        "losses": dict(lost),
        "wrong_pairs": wrong,
        "back_s_median": sorted(back)[len(back) // 2] if back else None,
        "back_s_longest": max(back, default=None),
    }


@click.command()
@click.option("--times", default=30, show_default=True, type=click.IntRange(1, 10_000), help="Times of each.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(times: int, json_path: Path | None) -> None:
    """Print how soon a camera, and the serial line, are back in service, and the pages that were lost meanwhile."""
    go_on_inside("analysis.hardware.plugs")
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        stage = Stage(small_cameras(), Path(folder))
        try:
            with source_of(stage, TOLERANCE_S, REPEATS) as source:
                camera = stage.fakes[1]
                for what, unplug, plug in (
                    ("camera", camera.close, camera.start),
                    ("serial line", stage.port.unplug, stage.port.plug),
                ):
                    found = figures[what] = unplugged(source, stage, unplug, plug, times, what)
                    median, longest = found["back_s_median"], found["back_s_longest"]
                    back = "never read again" if median is None else f"read after {median:.2f} s, {longest:.2f} at most"
                    click.echo(
                        f"{what} unplugged {times} times: {found['pages_lost']} pages lost, "
                        f"{found['wrong_pairs']} wrong; plugged in, {back}"
                    )
        finally:
            stage.close()
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.plugs"))
