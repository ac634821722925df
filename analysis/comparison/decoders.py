"""Every decoder on the same data set, against the oracle: same recording, same held-out pages.

    python -m analysis.comparison.decoders --angle -0.6 --out runs/decoders
    python -m analysis.comparison.decoders --method coherent --size 64x2x0 --size 96x2x1 --steps 1500 --out runs/sizes

Coherent, wave and oracle share network, steps and seeds. Refined is coherent and makes a further pass, as wave-refined
is wave and oracle-refined the oracle. Fast is coherent with less of everything. The oracle knows the simulated truth:
geometry, cameras, reference; the signal's own power is taken off its frames; then the wave adjoint and the same
network. None, mode and ray are the published decoders, with their own network and training. Image shift and piston of
every page, held-out ones too, are found from all of its symbols, for each method alike; the piston of a figure is found
from pilots. Interrupted, it goes on where it was; all lies in --out. What was trained on the same data set before and
kept (--keep) is only measured again.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import click

from analysis.comparison.data_set import data_set_name, recorded
from analysis.comparison.decoders_figure import draw, title
from analysis.comparison.levels import LEVEL_HEADER
from analysis.comparison.methods.bench import ORACLE, Bench
from analysis.comparison.methods.published import published_method
from analysis.comparison.methods.symbols import SYMBOL_METHODS, symbol_method
from analysis.comparison.outcome import FOOTNOTE, HEADER, Outcome
from analysis.comparison.weight_store import TRAINED, WeightStore
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFolder
from lightpage.device.profile import load_profile
from lightpage.device.state import Device, Sensor, ideal_device
from lightpage.metrics.provenance import write_figures
from lightpage.train.fitting.memory import keep_freed_memory
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.presets import FAST
from lightpage.train.published.localizers import NAMES as PUBLISHED
from lightpage.train.published.trainer import published_choices
from lightpage.train.runs import sole_writer


class Size(click.ParamType[str]):
    """Channels, blocks and depth of a network, e.g. ``96x2x0``."""

    name = "channels x blocks x depth"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if not re.fullmatch(r"[1-9]\d{0,3}x[1-9]\d?x[0-4]", value):
            self.fail(f"{value!r}: wanted CHANNELSxBLOCKSxDEPTH, as {DEFAULT_SIZE}", param, ctx)
        return value


METHODS = (*PUBLISHED, *SYMBOL_METHODS)
DEFAULT_SIZE = f"{Hyperparameters.channels}x{Hyperparameters.blocks}x{Hyperparameters.depth}"


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option(
    "--angle", "angles_deg", type=float, multiple=True, default=(-0.6,), show_default=True, help="Pipe angle, degrees."
)
@click.option(
    "--full-well", "full_wells", type=float, multiple=True, default=(32.0,), show_default=True, help="Electrons: noise."
)
@click.option(
    "--exposure",
    "exposures",
    type=float,
    multiple=True,
    default=(Sensor().exposure_relative,),
    show_default=True,
    help="Light, against what just fills the well.",
)
@click.option(
    "--symbol-size",
    "symbol_sizes",
    type=click.IntRange(1, 64),
    multiple=True,
    help="Edge of a symbol, modulator pixels; the profile's if left out.",
)
@click.option(
    "--ideal",
    is_flag=True,
    help="A device without defects but the pipe's angle and noise, its lenses as in the profile.",
)
@click.option(
    "--pages", type=click.IntRange(12), default=500, show_default=True, help="Pages, 5% for validation and 5% held out."
)
@click.option("--steps", type=click.IntRange(10), default=6000, show_default=True)
@click.option(
    "--size", "sizes", type=Size(), multiple=True, default=(DEFAULT_SIZE,), show_default=True, help="Network."
)
@click.option(
    "--refinements",
    type=click.IntRange(1, 4),
    default=1,
    show_default=True,
    help="Further passes of the refined method.",
)
@click.option(
    "--published-steps",
    type=click.IntRange(10),
    help="Steps of the published decoders; their authors' 50 passes if left out.",
)
@click.option(
    "--published-channels", type=click.IntRange(4), multiple=True, default=(32,), show_default=True, help="Network."
)
@click.option("--method", "names", type=click.Choice(METHODS), multiple=True, default=METHODS, show_default=True)
@click.option(
    "--levels",
    type=click.IntRange(2, 255),
    multiple=True,
    help="Judge confidences among so many levels too, on pages of their own; not of the published decoders.",
)
@click.option("--seed", type=click.IntRange(min=0), default=5000, show_default=True)
@click.option(
    "--trained",
    type=click.Path(file_okay=False, path_type=Path),
    default=TRAINED,
    show_default="those of this repository",
    help="Folder of methods that are trained already.",
)
@click.option("--keep", "keeps", is_flag=True, help="Keep what is trained in that folder.")
@click.option("--out", type=OutputFolder(), required=True, help="Folder for features, runs, figures.json.")
def main(
    profile_name: str,
    angles_deg: tuple[float, ...],
    full_wells: tuple[float, ...],
    exposures: tuple[float, ...],
    symbol_sizes: tuple[int, ...],
    ideal: bool,
    pages: int,
    steps: int,
    sizes: tuple[str, ...],
    refinements: int,
    published_steps: int | None,
    published_channels: tuple[int, ...],
    names: tuple[str, ...],
    levels: tuple[int, ...],
    seed: int,
    trained: Path,
    keeps: bool,
    out: Path,
) -> None:
    """Train every method on the same pages, data set by data set, and print what it says of held-out ones."""
    keep_freed_memory()
    nominal = load_profile(profile_name)
    click.get_current_context().with_resource(sole_writer(out))
    measured: list[dict[str, Any]] = []
    symbol_sizes = symbol_sizes or (nominal.page.symbol_size_px,)
    for angle_deg, full_well, exposure, size_px in product(angles_deg, full_wells, exposures, symbol_sizes):
        profile = nominal.with_symbols_of(size_px)
        settings = {
            "geometry.pipe_angle_deg": angle_deg,
            "sensor.full_well_e": full_well,
            "sensor.exposure_relative": exposure,
        }
        usual = ideal_device() if ideal else Device()
        device = usual.with_settings([f"{key}={value}" for key, value in settings.items()])
        folder = out / data_set_name(device, size_px, "-ideal" if ideal else "")
        kept = trained / Path(profile_name).stem / folder.name
        with recorded(profile, device, pages, seed, folder) as recording:
            bench = Bench.of(recording, profile, device, levels, seed, WeightStore(folder, kept, keeps))
            runs: list[Callable[[], Outcome]] = []
            for name in names:
                if name in PUBLISHED:
                    authors = replace(published_choices(name, profile, len(bench.training)), seed=seed)
                    authors = authors if published_steps is None else replace(authors, steps=published_steps)
                    widths = [replace(authors, channels=(width, 2 * width)) for width in published_channels]
                    runs += [partial(published_method, bench, name, choices) for choices in widths]
                else:
                    common = Hyperparameters(steps=steps, seed=seed, refinements=refinements)
                    own = sizes[:1] if name == FAST else sizes  # whose size is fixed
                    runs += [partial(symbol_method, bench, name, size, common) for size in own]
            outcomes: list[Outcome] = []
            data_set: dict[str, Any] = {}
            for run in runs:
                outcomes = compared([*outcomes, run()])
                click.echo(f"{HEADER}\n{outcomes[-1].line()}", err=True)
                data_set = {
                    "angle_deg": angle_deg,
                    "angle_error_deg": bench.fitted.angle_deg(profile) - angle_deg,
                    "full_well_e": full_well,
                    "exposure": exposure,
                    "symbol_size_px": size_px,
                    "ideal": ideal,
                    "outcomes": [outcome.as_json() for outcome in outcomes],
                }
                figures = {"pages": pages, "seed": seed, "data_sets": [*measured, data_set]}
                inputs = {"profile": nominal.to_toml(), "weights": trained / Path(profile_name).stem}
                write_figures(out / "figures.json", figures, **inputs)
                draw([*measured, data_set], out)
        measured.append(data_set)
        click.echo(f"\n{title(data_set)}")
        click.echo("\n".join([HEADER, *(outcome.line() for outcome in outcomes)]))
        if not all(outcome.is_settled for outcome in outcomes):
            click.echo(FOOTNOTE)
        if levels:
            lines = [figures.line(o.method, o.size) for o in outcomes for figures in o.by_levels]
            click.echo("\n".join([LEVEL_HEADER, *lines]))


def compared(outcomes: list[Outcome]) -> list[Outcome]:
    """The outcomes with what they reached over the oracle, and the others over the best of the published decoders.

    That oracle has a network of the same size, if there was one, and makes as many passes, if one did.
    """
    oracles = {(o.passes, o.size): o.air for o in outcomes if o.method.startswith(ORACLE)}
    once = [air for (passes, _), air in oracles.items() if passes == 1]
    published = [outcome.air for outcome in outcomes if outcome.method in PUBLISHED]

    def over(outcome: Outcome) -> Outcome:
        alike = [oracles[passes, outcome.size] for passes in (outcome.passes, 1) if (passes, outcome.size) in oracles]
        if alike or once:
            outcome = replace(outcome, over_oracle=outcome.air / (alike[0] if alike else max(once)))
        if published and outcome.method not in PUBLISHED:
            outcome = replace(outcome, over_published=outcome.air / max(published))
        return outcome

    return [over(outcome) for outcome in outcomes]


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.comparison.decoders"))
