"""A kept method of the comparison as a bundle, so that the runtime can be measured with what was trained.

    python -m analysis.comparison.kept_bundle --kept analysis/weights/bench/-0.6deg-32e-4px --out bundle.zip

A few pages of the data set are simulated anew: they say how strong the light is, and how well calibrated the
concentrations are.
"""

from __future__ import annotations

import sys
from pathlib import Path

import click

from analysis.comparison.data_set import CALIBRATED, data_set_of, simulate
from analysis.comparison.kept_decoder import kappa_scale, kept_decoder, validation_air
from analysis.comparison.weight_store import CALIBRATION
from lightpage.calibration.document import load_calibration
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import NewPath, OutputFolder
from lightpage.errors import InvalidInputError
from lightpage.export.from_run import export_run
from lightpage.page.symbols import pilot_mask
from lightpage.recording.layout import hash_frames
from lightpage.recording.reader import Recording
from lightpage.train.fitting.fitted import FITTED
from lightpage.train.models.decoder import COHERENT
from lightpage.train.models.presets import FAST
from lightpage.train.runs import GOLDEN, REFERENCES, Run, save_arrays, save_weights
from lightpage.train.trainers.symbols import MATCHED_PAGES

JUDGED = 3
"""Pages by which concentrations are calibrated: thousands of symbols each."""


def export_kept(kept: Path, work: Path, out: Path, method: str = COHERENT, refinements: int = 1) -> None:
    """Write the bundle of a method.

    Args:
        kept: folder of the data set.
        work: folder for pages and run; made, and gone on with if it is there.
        out: new bundle.
        method: fast, or the localizer of a method.
        refinements: passes behind the first, 0 or 1.

    Raises:
        InvalidInputError: no such method is kept.
    """
    profile, device, seed = data_set_of(kept)
    trained = next((folder for folder in sorted((kept / method).glob("*")) if (folder / FITTED).exists()), None)
    if trained is None:
        raise InvalidInputError(f"--kept {kept}", f"no trained {method}", "a method that is kept there")
    localizer = COHERENT if method == FAST else method
    work.mkdir(parents=True, exist_ok=True)
    calibration = load_calibration(kept / CALIBRATION)
    path = work / "recording.h5"
    simulate(path, profile, device, CALIBRATED + MATCHED_PAGES + JUDGED, seed)
    with Recording.open(path) as recording:
        decoder = kept_decoder(trained, profile, calibration, recording, localizer, refinements)
        references, mask = recording.references(), pilot_mask(profile)
        judged = range(CALIBRATED + MATCHED_PAGES, recording.pages)
        run = Run(
            localizer=localizer,
            profile_toml=profile.to_toml(),
            calibration_toml=calibration.to_toml(),
            hyperparameters=decoder.choices,
            camera_bit_depth=recording.bit_depth,
            trained_pages=tuple(hash_frames(recording.frames(page)) for page in judged),
            validation_air=validation_air(trained, refinements),
            kappa_scale=kappa_scale(decoder, profile, calibration, recording, judged),
            seconds=0.0,
            provenance={"command": f"python -m analysis.comparison.kept_bundle --kept {kept.name}", "seed": seed},
        )
        save_weights(decoder.state_dict(), work)
        save_arrays(
            work / REFERENCES,
            {"in_phase": references.in_phase, "quadrature": references.quadrature, "pilots": mask},
        )
        golden = recording.frames(judged[0])
        save_arrays(work / GOLDEN, {"in_phase": golden.in_phase, "quadrature": golden.quadrature})
    run.save(work)
    export_run(work, out, name=kept.name, version="kept")


@click.command()
@click.option("--kept", required=True, type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--method", default=COHERENT, show_default=True, help="fast, or the localizer of a method.")
@click.option("--refinements", default=1, show_default=True, type=click.IntRange(0, 1))
@click.option("--work", default=Path("runs/kept-bundle"), show_default=True, type=OutputFolder())
@click.option("--out", required=True, type=NewPath())
def main(kept: Path, method: str, refinements: int, work: Path, out: Path) -> None:
    """Export a kept method of the comparison as a bundle."""
    export_kept(kept, work / kept.name, out, method, refinements)
    click.echo(out)


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.comparison.kept_bundle"))
