"""`lightpage unpack`: write the frames and symbols of a recording as files that other programs read."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from lightpage.cli.options import JSON
from lightpage.cli.paths import NewPath
from lightpage.files import write_json
from lightpage.foreign.unpacking import Form
from lightpage.foreign.unpacking import unpack as unpack_recording
from lightpage.recording.reader import Recording
from lightpage.words import counted


@click.command()
@click.argument("recording", metavar="R.h5", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=NewPath(), help="A new folder.")
@click.option(
    "--form",
    type=click.Choice([each.value for each in Form]),
    default="tiff",
    show_default=True,
    help="Format of the files.",
)
@JSON
def unpack(recording: Path, out: Path, form: str, json_path: Path | None) -> None:
    """Write frames, reference frames and symbols of a recording as TIFF, .npy, PNG, .mat (7.3) or HDF5.

    Pages lie along the first axis, in MATLAB along the last. Frames are free of their black level. Symbols are .npy
    beside TIFF and PNG.
    """
    with Recording.open(recording) as file:
        options = unpack_recording(file, Form(form), out)
        write_json(json_path, {"pages": file.pages, "options": options})
        told = {"--profile": "P", **options, "--levels": str(file.levels), "--bit-depth": str(file.bit_depth)}
        words = [word for option in told.items() for word in option]
        command = shlex.join(["lightpage", "import", *words, "--out", "R.h5"])
        click.echo(f"{out}: {counted(file.pages, 'page')}. To import them again:\n{command}")
