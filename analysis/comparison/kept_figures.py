"""Measures what kept decoders read, beside the same ones as they were trained: on new pages of their device.

    python -m analysis.comparison.kept_figures --kept analysis/weights/bench/-0.6deg-32e-4px \
        --trained runs/decoders/-0.6deg-32e-4px --out runs/kept-figures

Both go the way of `analysis.comparison.decoders`, each with its own second pass.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click

from analysis.comparison.data_set import CALIBRATED, data_set_of, recorded
from analysis.comparison.methods.bench import Bench
from analysis.comparison.methods.published import published_method
from analysis.comparison.methods.symbols import FIRST_PASSES, symbol_method
from analysis.comparison.outcome import Outcome
from analysis.comparison.weight_store import CALIBRATION, WeightStore, place
from lightpage.calibration.document import load_calibration
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFolder
from lightpage.recording.reader import Recording
from lightpage.run_files import BEGUN
from lightpage.train.fitting.fitted import FITTED_WEIGHTS
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.published.localizers import NAMES as PUBLISHED
from lightpage.train.published.training import PublishedChoices
from lightpage.train.runs import renamed, sole_writer
from lightpage.train.trainers.symbols import MATCHED_PAGES

FOURTH_DIGIT = 0.0005
"""Half of it, of an AIR in bits."""


def outcomes(kept: Path, recording: Recording, out: Path, trained: Path | None = None) -> Iterator[Outcome]:
    """Yield what each kept method reads, in the order of their names; with the weights of `trained` where given.

    Concentrations are calibrated on the same pages for all.

    Args:
        kept: folder of a data set.
        recording: new pages of its device; what comes behind the matched ones is read.
        out: folder for features.
        trained: the data set's folder with its runs.
    """
    profile, device, seed = data_set_of(kept)
    matched = CALIBRATED + MATCHED_PAGES
    bench = Bench(
        recording,
        profile,
        device,
        load_calibration(kept / CALIBRATION),
        out,
        training=range(CALIBRATED, matched),
        validation=range(CALIBRATED, matched),
        unseen=range(matched, recording.pages),
        levels=(),
        seed=seed,
        kept=WeightStore(out, out),
    )
    for begun in sorted(kept.glob(f"*/*/{BEGUN}")):
        at = begun.parent.relative_to(kept)
        place(begun.parent, out / at)
        if trained is not None:
            for path in (trained / at).rglob(FITTED_WEIGHTS):
                shutil.copyfile(path, out / path.relative_to(trained))
        options = renamed(json.loads(begun.read_text()))
        del options["format"]
        if (name := at.parent.name) in PUBLISHED:
            yield published_method(bench, name, PublishedChoices(**options | {"channels": tuple(options["channels"])}))
            continue
        choices, size = Hyperparameters(**options), at.name.split("-")[0]
        yield symbol_method(bench, name, size, choices)
        for again in [again for again, first in FIRST_PASSES.items() if first == name]:
            if passes := len(list((kept / at).glob("refinement-*"))):
                yield symbol_method(bench, again, size, replace(choices, refinements=passes))


@click.command()
@click.option("--kept", required=True, type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option(
    "--trained",
    required=True,
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="Folder of the same data set with the runs that were kept.",
)
@click.option("--pages", type=click.IntRange(1), default=4, show_default=True)
@click.option("--out", type=OutputFolder(), required=True, help="Folder for recording and features.")
def main(kept: Path, trained: Path, pages: int, out: Path) -> None:
    """Print what kept decoders read beside the same ones as they were trained."""
    click.get_current_context().with_resource(sole_writer(out))
    profile, device, seed = data_set_of(kept)
    click.echo(f"{'method':<16} {'AIR trained':>11} {'kept':>8} {'change':>9} {'symbol errors':>13} {'kept':>7}")
    with recorded(profile, device, MATCHED_PAGES + pages, seed + 1, out) as recording:
        before = outcomes(kept, recording, out / "trained", trained)
        for was, now in zip(before, outcomes(kept, recording, out / "kept"), strict=True):
            change = now.air - was.air
            click.echo(
                f"{now.method:<16} {was.air:>11.4f} {now.air:>8.4f} {change:>+9.5f} {was.symbol_error_rate:>13.4f} "
                f"{now.symbol_error_rate:>7.4f}{'' if abs(change) < FOURTH_DIGIT else '  off'}"
            )


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.comparison.kept_figures"))
