"""`lightpage unpack`: write the frames and symbols of a recording as files that other programs read."""

from __future__ import annotations

from pathlib import Path

import click

from lightpage.cli.options import JSON
from lightpage.cli.paths import NewPath
from lightpage.errors import InvalidInputError
from lightpage.files import write_json
from lightpage.foreign.unpacking import Form
from lightpage.foreign.unpacking import unpack as unpack_recording
from lightpage.recording.reader import Recording


@click.command()
@click.argument("recording", metavar="R.h5", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=NewPath(), help="A new folder.")
@click.option(
    "--form", type=click.Choice([each.value for each in Form]), default="tiff", show_default=True, help="Of the files."
)
@JSON
def unpack(recording: Path, out: Path, form: str, json_path: Path | None) -> None:
    """Write frames, reference frames and symbols of a recording as TIFF, .npy, PNG, .mat (7.3) or HDF5.

    Pages lie along the first axis, in MATLAB along the last. Frames are free of their black level. Symbols are .npy
    beside TIFF and PNG.
    """
    if out.exists():
        raise InvalidInputError(f"--out {out}", "something that exists", "a new name")
    with Recording.open(recording) as file:
        options = unpack_recording(file, Form(form), out)
        told = f" --levels {file.levels} --bit-depth {file.bit_depth}"
        write_json(json_path, {"pages": file.pages, "options": dict(each.split(" ", 1) for each in options)})
        click.echo(
            f"{out}: {file.pages} pages. They come back by:\nlightpage import {' '.join(options)}{told} --out R.h5"
        )
