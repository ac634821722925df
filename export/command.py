"""The command `lightpage export`: a finished training run to a bundle that the runtime loads."""

from __future__ import annotations

from pathlib import Path

import click

from lightpage.cli.options import JSON
from lightpage.cli.paths import NewPath
from lightpage.cli.progress_bar import percent_bar
from lightpage.export.from_run import export_run
from lightpage.export.half import PRECISIONS
from lightpage.files import write_json
from lightpage.progress import note
from lightpage.runtime.model.bundle.manifest import FLOAT32, Precision
from lightpage.train.commands.options import ACCEPT
from lightpage.train.runs import load_run


@click.command()
@click.argument("run", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--out", required=True, type=NewPath(), help="New bundle: a folder, or a .zip.")
@click.option("--name", default=None, help="Name of the bundle; the profile's if left out.")
@click.option(
    "--version", "version", default=None, help="Version of the bundle; its name, the time and a hash if left out."
)
@click.option("--recording", type=click.Path(path_type=Path), help="Choose the code of user bytes by its unseen pages.")
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
    run: Path,
    out: Path,
    name: str | None,
    version: str | None,
    recording: Path | None,
    precision: Precision,
    batches: bool,
    accept_wrong_fit: bool,
    json_path: Path | None,
) -> None:
    """Export a training run, proving the bundle against torch with the runtime's own decoder.

    With --recording the bundle also holds how user bytes are protected on the device's pages, as `lightpage code` would
    choose it by the pages of the recording that the run was not trained on.
    """
    if not accept_wrong_fit:
        load_run(run).calibration.check_good(f"run {run}, calibration", f", or {ACCEPT}")
    with percent_bar() as progress:
        bundle, error = export_run(run, out, name, version, progress, recording, precision, batches=batches)
    if bundle.code is None:
        how = "see `lightpage code`" if recording is not None else "export with --recording, or see `lightpage code`"
        note(f"the bundle has no code for user bytes: {how}")
    size = sum(len(data) for data in bundle.files.values())
    if json_path is not None:
        figures = {"bundle": str(out), "version": bundle.version, "parity_error": error, "unpacked_bytes": size}
        figures["code"] = None if bundle.code is None else bundle.code.model_dump()
        write_json(json_path, figures)
    click.echo(f"{out}: version {bundle.version}, p within {error:.1e} of torch, {size / 1e6:.1f} MB unpacked")
