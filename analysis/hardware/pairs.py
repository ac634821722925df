"""Shots over the whole chain with faults of every kind: how many pairs are wrong, what is lost, and why.

    python -m analysis.hardware.pairs --shots 2000 --json runs/pairs.json

Fake cameras send real packets, the pulse generator is on a serial port; every page shows its own number. A pair is
wrong if a frame shows another page than the one that was asked for. Runs in a private network.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import click
import numpy as np

from analysis.hardware.faulty_chain import Stage, numbers_shown, small_cameras, source_of
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.errors import LostShotError, Reason
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.device.acquisition.camera_source import CameraSource
from lightpage.virtual_device.namespace import go_on_inside

FAULTS = (
    "missed",
    "both missed",
    "late",
    "both late",
    "doubled",
    "packets lost",
    "leader lost",
    "held",
    "both held",
    "restarted",
)
DELAYS_S = (0.05, 0.1, 0.3, 0.45, 0.55, 0.6)
_CAPTURE_S = 5.0


def shoot(source: CameraSource, stage: Stage, shots: int, share: float, seed: int) -> dict[str, Any]:
    """Take shots, a share of them with a fault; what became of them."""
    rng = random.Random(seed)
    injected: Counter[str] = Counter()
    lost: dict[str, Counter[str]] = {}
    wrong, taken, harmless, seconds = 0, 0, 0, []
    for page in track(range(shots), "shots", total=shots):
        fault = rng.choice(FAULTS) if rng.random() < share else ""
        injected[fault or "none"] += 1
        stage.begin(fault, rng.randrange(2), rng.choice(DELAYS_S))
        begun = time.perf_counter()
        try:
            pair = source.shot(_CAPTURE_S, page).pair
        except LostShotError as error:
            lost.setdefault(fault or "none", Counter())[error.reason.value] += 1
        else:
            seconds.append(time.perf_counter() - begun)
            wrong += numbers_shown(pair) != [page, page]
            taken += 1
            harmless += bool(fault)
        finally:
            stage.end()
    named = {reason.value for reason in Reason}
    unnamed = sum(count for of in lost.values() for reason, count in of.items() if reason not in named)
    return {
        "shots": shots,
        "faults": shots - injected["none"],
        "injected": dict(injected),
        "taken": taken,
        "taken_with_a_fault": harmless,
        "wrong_pairs": wrong,
        "lost": {fault: dict(reasons) for fault, reasons in sorted(lost.items())},
        "lost_without_a_fault": sum(lost.get("none", Counter()).values()),
        "lost_unnamed": unnamed,
        "seconds_per_shot_median": float(np.median(seconds)) if seconds else None,
        "outcomes": dict(source.shots_by_outcome()),
    }


@click.command()
@click.option("--shots", default=2000, show_default=True, type=click.IntRange(1, 60_000), help="Shots with faults.")
@click.option("--clean-shots", default=500, show_default=True, type=click.IntRange(0, 60_000), help="Without faults.")
@click.option("--faults", default=0.35, show_default=True, type=click.FloatRange(0, 1), help="Share with a fault.")
@click.option("--tolerance", default=0.02, show_default=True, type=click.FloatRange(0.001, 0.5), help="Seconds.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(shots: int, clean_shots: int, faults: float, tolerance: float, seed: int, json_path: Path | None) -> None:
    """Print wrong pairs, losses by fault and reason, and the price of the rule where nothing goes wrong."""
    go_on_inside("analysis.hardware.pairs")
    small = small_cameras()
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        for name, count, share, repeats in (
            ("with faults", shots, faults, 0),
            ("without faults", clean_shots, 0.0, 0),
            ("without faults, one shot repeated", clean_shots, 0.0, 1),
        ):
            if not count:
                continue
            stage = Stage(small, Path(folder))
            try:
                with source_of(stage, tolerance, repeats) as source:
                    figures[name] = shoot(source, stage, count, share, seed)
            finally:
                stage.close()
            found = figures[name]
            click.echo(
                f"{name}: {found['shots']} shots, {found['faults']} with a fault; {found['taken']} taken "
                f"({found['taken_with_a_fault']} of them with a fault that did no harm), {found['wrong_pairs']} wrong; "
                f"{found['lost_without_a_fault']} lost without a fault"
            )
            for fault, reasons in found["lost"].items():
                told = ", ".join(f"{times} {reason}" for reason, times in sorted(reasons.items()))
                click.echo(f"  {fault:<14} {found['injected'].get(fault, 0):>5}: lost {told}")
    if json_path is not None:
        write_figures(json_path, figures)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.pairs"))
