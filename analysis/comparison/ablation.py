"""Ablation: each part of one coherent pass left out, compared with the whole decoder on the same pages.

    python -m analysis.comparison.ablation --angle -0.6 --out runs/ablation

Everything else is as in the method `coherent` of `analysis.comparison.decoders`; both share the recording if `--out` is
the same. Interrupted, it goes on where it was; all lies in --out.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import click
from torch import nn

from analysis.comparison.data_set import LEVELS, data_set_name, recorded
from analysis.comparison.methods.bench import Bench
from analysis.comparison.methods.judgement import judged
from analysis.comparison.outcome import HEADER, Outcome
from analysis.comparison.weight_store import TRAINED, WeightStore
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFolder
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.metrics.provenance import write_figures
from lightpage.train.data.feature_store import FeatureStore, fill
from lightpage.train.data.features import FeatureExtractor, PageFeatures
from lightpage.train.data.patches import training_pages
from lightpage.train.fitting.fit import fit_network
from lightpage.train.fitting.memory import keep_freed_memory
from lightpage.train.models.field import ROUNDS
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.network import SymbolUNet
from lightpage.train.processes import ONE
from lightpage.train.runs import sole_writer

NOTHING = "nothing"
REFLECTIONS, POSITIONS = "reflections", "positions"
SIGNAL_POWER, DESCENT, LOW_PASS = "signal-power", "descent", "low-pass"
PARTS = {
    NOTHING: "the whole decoder",
    REFLECTIONS: "light that was reflected on its way: only the direct branch is read",
    POSITIONS: "filters that depend on where a symbol lies (FiLM)",
    SIGNAL_POWER: "the signal's own power in the field's recovery, the descent with it: equations are linear",
    DESCENT: "the descent to the most likely field: the closed solution of both equations is taken",
    LOW_PASS: "the low-pass before frames are sampled",
}


class Unconditioned(SymbolUNet):
    """A network whose filters are the same everywhere: their modulation stays at its first value, none."""

    def __init__(self, light_channels: int, channels: int = 96, blocks: int = 2, depth: int = 0) -> None:
        super().__init__(light_channels, channels, blocks, depth)
        self.where.requires_grad_(False)


def extractor_without(part: str, bench: Bench) -> FeatureExtractor:
    """Features of the calibrated device, without a part of the field's recovery."""
    choices = Hyperparameters(field_rounds=0 if part == DESCENT else ROUNDS)
    found = FeatureExtractor(bench.calibrated_device(), choices=choices, with_signal_power=part != SIGNAL_POWER)
    if part == LOW_PASS:
        found.recovery.add_module("prefilter", nn.Identity())
    return found


def features_without(part: str, bench: Bench, start: int, shift: tuple[float, float]) -> Iterator[PageFeatures]:
    """Features of all pages from one on, without a part."""
    for page in extractor_without(part, bench).pages(bench.recording, bench.pages[start:], shift):
        if part == REFLECTIONS:
            page.light[:, 1:] = 0  # the direct branch is the first
        yield page


def without(part: str, bench: Bench, choices: Hyperparameters) -> Outcome:
    """Train the decoder without a part, or go on with it, and measure it on the held-out pages."""
    at = bench.out / "ablation" / part
    # positions are left out of the network alone
    features = bench.out / "ablation" / (NOTHING if part == POSITIONS else part) / "features"
    preparing = fill(
        features,
        bench.fitted.to_toml(),
        len(bench.pages),
        lambda start, shift: features_without(part, bench, start, shift),
        f"features without {part}",
    )
    validation, unseen = bench.held_out(features)
    training = training_pages([FeatureStore(features, range(len(bench.training)))], bench.mask, choices, LEVELS)
    folder = bench.begun(at / f"{choices.steps}", {"without": part, **asdict(choices)})
    kind = Unconditioned if part == POSITIONS else SymbolUNet
    fitted = fit_network(folder, choices, bench.mask, LEVELS, training, validation, kind=kind, processes=ONE)
    drawn = choices.drawn(bench.profile.page_shape)
    size = f"{choices.channels}x{choices.blocks}x{choices.depth}"
    return judged(bench, part, size, choices.steps, folder, fitted, validation, unseen, preparing, drawn)


@click.command()
@click.option("--profile", "profile_name", default="bench", show_default=True, help="Shipped profile or TOML file.")
@click.option("--angle", "angle_deg", type=float, default=-0.6, show_default=True, help="Pipe angle, degrees.")
@click.option("--full-well", type=float, default=32.0, show_default=True, help="Electrons: noise.")
@click.option("--pages", type=click.IntRange(12), default=500, show_default=True)
@click.option("--steps", type=click.IntRange(10), default=1500, show_default=True)
@click.option("--part", "parts", type=click.Choice(list(PARTS)), multiple=True, default=list(PARTS), show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=5000, show_default=True)
@click.option("--out", type=OutputFolder(), required=True, help="Folder for all of it, ablation.json too.")
def main(
    profile_name: str,
    angle_deg: float,
    full_well: float,
    pages: int,
    steps: int,
    parts: tuple[str, ...],
    seed: int,
    out: Path,
) -> None:
    """Leave out one part at a time, and print what is left of the AIR."""
    keep_freed_memory()
    profile = load_profile(profile_name)
    click.get_current_context().with_resource(sole_writer(out))
    device = Device().with_settings([f"geometry.pipe_angle_deg={angle_deg}", f"sensor.full_well_e={full_well}"])
    name = data_set_name(device, profile.page.symbol_size_px)
    choices = Hyperparameters(steps=steps, seed=seed)
    with recorded(profile, device, pages, seed, out / name) as recording:
        kept = WeightStore(out / name, TRAINED / Path(profile_name).stem / name)
        bench = Bench.of(recording, profile, device, (), seed, kept)
        outcomes: list[Outcome] = []
        for part in parts:
            outcomes.append(without(part, bench, choices))
            click.echo(f"{HEADER}\n{outcomes[-1].line()}", err=True)
            write_figures(out / "ablation.json", {"outcomes": [outcome.as_json() for outcome in outcomes]})
    click.echo(HEADER)
    for outcome in outcomes:
        click.echo(outcome.line())
    click.echo("\nwithout")
    for part in parts:
        click.echo(f"{part:<16} {PARTS[part]}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.comparison.ablation"))
