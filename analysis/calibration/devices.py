"""Calibration from nominal on drawn devices: angle errors, coherence, verdict, time.

    python -m analysis.calibration.devices --devices 20 --first-seed 1000 --pages 2 --json F
    python -m analysis.calibration.devices --devices 50 --draw rough --json F
    python -m analysis.calibration.devices --devices 3 --foreign --json F
    python -m analysis.calibration.devices --symbol-size 2 --devices 3 --json F

Devices are drawn over the whole capture range, or as they scatter on a bench (`rough`). The coherence of the calibrated
geometry is put in ratio to that of the true one (the oracle), fields recovered with the true cameras and turn, the
image's drift included. The cameras' relation is how far the quadrature camera is placed wrong against the in-phase
one, root mean square over the page: the field that is recovered from both depends on it. A foreign device comes from a
simulator that shares nothing with this project; its true geometry has other parameters, so it has neither. An
interrupted run goes on where it stopped: seeds that are in the JSON file are not computed again, failed ones are; a
file of another format of runs (`lightpage.train.runs.FORMAT`) is refused.
"""

from __future__ import annotations

import hashlib
import json
import statistics
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Protocol, TypeVar

import click

from analysis.calibration.bench import HEADER, Bench, Outcome
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.device.profile import load_profile
from lightpage.device.state import draw_device, draw_rough
from lightpage.errors import InvalidInputError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.train.runs import FORMAT

WANTED_SHARE = 0.95
"""Of the oracle's coherence, for a device to count as found."""

DRAWN = {"capture": draw_device, "rough": draw_rough}


def summary(outcomes: list[Outcome]) -> dict[str, float | int | None]:
    """Worst and median over the devices that were calibrated; shares over all."""
    errors = [o.angle_error_deg for o in outcomes if o.angle_error_deg is not None]
    seconds = [o.seconds for o in outcomes if o.seconds is not None]
    with_oracle = [o for o in outcomes if o.oracle_coherence is not None]
    near = sum(1 for o in with_oracle if o.ratio is not None and o.ratio >= WANTED_SHARE)
    relations = [o.relation_error_px for o in outcomes if o.relation_error_px is not None]
    ratios = [o.ratio for o in with_oracle if o.ratio is not None]
    return {
        "devices": len(outcomes),
        "called_good": sum(o.verdict == "good" for o in outcomes),
        "calibrated": len(errors),
        "angle_error_deg_worst": max(errors, default=None),
        "angle_error_deg_median": statistics.median(errors) if errors else None,
        "near_oracle": near if with_oracle else None,
        "near_oracle_share": near / len(with_oracle) if with_oracle else None,
        "ratio_worst": min(ratios, default=None),
        "relation_error_px_worst": max(relations, default=None),
        "relation_error_px_median": statistics.median(relations) if relations else None,
        "seconds_median": statistics.median(seconds) if seconds else None,
        "seconds_worst": max(seconds, default=None),
    }


class Outcomes(Protocol):
    """Figures of a device that is drawn by a seed."""

    @property
    def seed(self) -> int: ...


T = TypeVar("T", bound=Outcomes)


def load(path: Path, settings: dict[str, object], kind: Callable[..., T]) -> dict[int, T]:
    """Outcomes by seed of an earlier run with the same settings.

    Raises:
        InvalidInputError: the file is something else, or of other settings.
    """
    if not path.exists():
        return {}
    try:
        data = json.loads(path.read_text("utf-8"))
        found, outcomes = data["settings"], {o["seed"]: kind(**o) for o in data["outcomes"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(f"--json {path}", error, "a file of this benchmark, or a new name") from None
    if found != settings:
        raise InvalidInputError(f"--json {path}", f"results of {found}", f"results of {settings}, or a new name")
    return outcomes


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True)
@click.option(
    "--symbol-size", type=click.IntRange(1, 64), help="Edge of a symbol, modulator pixels.  [default: the profile's]"
)
@click.option("--devices", default=20, show_default=True, type=click.IntRange(1))
@click.option("--first-seed", default=1000, show_default=True, type=click.IntRange(0))
@click.option("--pages", default=2, show_default=True, type=click.IntRange(1, 4), help="Known pages a device.")
@click.option("--draw", type=click.Choice(list(DRAWN)), default="capture", show_default=True)
@click.option("--foreign", is_flag=True, help="Devices of the other simulator.")
@click.option("--json", "json_path", required=True, type=OutputFile())
def main(
    profile_name: str,
    symbol_size: int | None,
    devices: int,
    first_seed: int,
    pages: int,
    draw: str,
    foreign: bool,
    json_path: Path,
) -> None:
    """Calibrate drawn devices and compare with the truth."""
    profile = load_profile(profile_name)
    if symbol_size is not None:
        if foreign:
            raise InvalidInputError(
                "--symbol-size", f"{symbol_size} with --foreign", "one of them: its pages are its own"
            )
        profile = profile.with_symbols_of(symbol_size)
    settings: dict[str, object] = {"format": FORMAT, "pages": pages, "foreign": foreign, "draw": draw}
    settings |= {"profile": profile_name, "profile_sha256": hashlib.sha256(profile.to_toml().encode()).hexdigest()}
    done = {seed: o for seed, o in load(json_path, settings, Outcome).items() if o.failure is None}
    bench = Bench(profile, pages, DRAWN[draw])
    click.echo(HEADER)
    seeds = range(first_seed, first_seed + devices)
    for seed in track(seeds, "calibrate", unit="device"):
        if seed not in done:
            done[seed] = bench.foreign(seed) if foreign else bench.own(seed)
            document = {"settings": settings, "outcomes": [asdict(done[s]) for s in sorted(done)]}
            write_figures(json_path, document)
        click.echo(done[seed].line())
    figures = summary([done[seed] for seed in seeds])
    document = {"settings": settings, "summary": figures, "outcomes": [asdict(done[s]) for s in sorted(done)]}
    write_figures(json_path, document)
    for name, value in figures.items():
        click.echo(f"{name:<24} {value if not isinstance(value, float) else format(value, '.4g')}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.calibration.devices"))
