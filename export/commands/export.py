"""The command `lightpage export`: a finished training run, or a calibration, to a bundle that the runtime loads."""

from __future__ import annotations

from pathlib import Path

import click

from lightpage.calibration.document import load_calibration
from lightpage.cli.options import JSON, named_profile, profile_option
from lightpage.cli.paths import NewPath
from lightpage.cli.progress_bar import percent_bar
from lightpage.errors import InvalidInputError
from lightpage.export.from_calibration import export_calibration
from lightpage.export.from_run import export_run
from lightpage.export.half import PRECISIONS
from lightpage.files import write_json
from lightpage.progress import note
from lightpage.recording.reader import Recording
from lightpage.runtime.model.bundle.manifest import FLOAT32, Precision
from lightpage.runtime.recalibration.noise import MOST_STEPS
from lightpage.train.commands.options import ACCEPT
from lightpage.train.runs import load_run


@click.command()
@click.argument("run", type=click.Path(path_type=Path, exists=True, file_okay=False), required=False)
@click.option(
    "--calibration",
    "calibration_path",
    type=click.Path(path_type=Path),
    help="Export a calibration in place of a run: pages are read by the fitted waves, without training.",
)
@profile_option
@click.option("--steps", type=click.IntRange(1, MOST_STEPS), help="Gauss-Newton steps of a page, with --calibration.")
@click.option("--out", required=True, type=NewPath(), help="New bundle: a folder, or a .zip.")
@click.option("--name", default=None, help="Name of the bundle; the profile's if left out.")
@click.option(
    "--version", "version", default=None, help="Version of the bundle; its name, the time and a hash if left out."
)
@click.option(
    "--recording",
    type=click.Path(path_type=Path),
    help="Choose the code of user bytes by its unseen pages; with --calibration, its known pages are wanted too.",
)
@click.option(
    "--precision",
    type=click.Choice(PRECISIONS),
    default=FLOAT32,
    show_default=True,
    help="Arithmetic of network and waves; float16 helps only on a GPU.",
)
@click.option(
    "--batches/--no-batches",
    default=False,
    show_default=True,
    help="Hold the decoder for many pages too, which a GPU runs.",
)
@click.option(ACCEPT, "accept_wrong_fit", is_flag=True, help="Export a run whose calibration is a wrong fit too.")
@JSON
def export(
    run: Path | None,
    calibration_path: Path | None,
    profile_name: str | None,
    steps: int | None,
    out: Path,
    name: str | None,
    version: str | None,
    recording: Path | None,
    precision: Precision,
    batches: bool,
    accept_wrong_fit: bool,
    json_path: Path | None,
) -> None:
    """Export a training run, or a calibration, proving the bundle against torch with the runtime's own decoder.

    A bundle of a calibration needs no run: `lightpage export --calibration C.toml --recording R.h5 --out B.zip`.

    With --recording the bundle also holds how user bytes are protected on the device's pages, as `lightpage code` would
    choose it by the pages of the recording that the run was not trained on.
    """
    if calibration_path is not None:
        if run is not None or precision != FLOAT32 or batches:
            raise InvalidInputError("--calibration", "a run, --precision or --batches beside it", "it alone")
        if recording is None:
            raise InvalidInputError("--recording", "none", "the recording that the calibration was made of")
        calibration = load_calibration(calibration_path)
        if not accept_wrong_fit:
            calibration.check_good(f"calibration {calibration_path}", f", or {ACCEPT}")
        with Recording.open(recording) as file, percent_bar() as progress:
            profile = file.header.device(named_profile(profile_name))
            bundle, error = export_calibration(calibration, file, profile, out, name, version, progress, steps)
    elif run is not None:
        if steps is not None:
            raise InvalidInputError("--steps", steps, "none: a run's decoder is a network")
        if not accept_wrong_fit:
            load_run(run).calibration.check_good(f"run {run}, calibration", f", or {ACCEPT}")
        with percent_bar() as progress:
            bundle, error = export_run(run, out, name, version, progress, recording, precision, batches=batches)
    else:
        raise InvalidInputError("what to export", "nothing", "a RUN, or --calibration C.toml --recording R.h5")
    if bundle.code is None:
        how = "see `lightpage code`" if recording is not None else "export with --recording, or see `lightpage code`"
        note(f"the bundle has no code for user bytes: {how}")
    size = sum(len(data) for data in bundle.files.values())
    if json_path is not None:
        figures = {"bundle": str(out), "version": bundle.version, "parity_error": error, "unpacked_bytes": size}
        figures["code"] = None if bundle.code is None else bundle.code.model_dump()
        write_json(json_path, figures)
    click.echo(f"{out}: version {bundle.version}, p within {error:.1e} of torch, {size / 1e6:.1f} MB unpacked")
