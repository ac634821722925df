"""`lightpage code`: chooses how user bytes are protected on a device's pages."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from lightpage.cli.paths import NewPath, OutputFile
from lightpage.codec.choose import HEADER, HEADROOM
from lightpage.errors import InvalidInputError
from lightpage.files import write_json
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import choose_code
from lightpage.runtime.commands.execution import Load, decoder_options
from lightpage.runtime.model.bundle.bundle import write_bundle
from lightpage.runtime.model.decoding.image_tracker import tracker_for


@click.command()
@decoder_options
@click.option("--recording", required=True, type=click.Path(), help="HDF5 recording with known symbols.")
@click.option("--out", type=OutputFile(), help="Write the code to this TOML file.")
@click.option("--out-bundle", type=NewPath(), help="Write the bundle with this code in it: a folder, or a .zip.")
@click.option("--version", help="Of that bundle.")
@click.option(
    "--headroom",
    type=click.FloatRange(0, 0.5),
    default=HEADROOM,
    show_default=True,
    help="Share of what a symbol carries that is kept for drift.",
)
@click.option("--json", "json_path", type=OutputFile(), help="Write the choices to this file.")
def code(
    load: Load,
    recording: str,
    out: Path | None,
    out_bundle: Path | None,
    version: str | None,
    headroom: float,
    json_path: Path | None,
) -> None:
    """Choose levels and rate of a device's page code by pages of a recording that the bundle has not seen.

    The rate is the one that 999 of 1,000 pages still carry, as far as these pages can say: more pages, a higher rate.
    """
    if out is None and out_bundle is None:
        raise InvalidInputError("options", "neither --out nor --out-bundle", "at least one of them")
    if (version is None) != (out_bundle is None):
        raise InvalidInputError("options", "one of --out-bundle and --version", "both or neither")
    decoder = load()
    with Recording.open(recording) as pages:
        best, tried = choose_code(decoder, pages, tracker_for(decoder), headroom)
    if out is not None:
        best.code.save(out)
    if out_bundle is not None:
        manifest = decoder.bundle.manifest.model_copy(update={"code": best.code.to_toml(), "version": version})
        write_bundle(out_bundle, manifest, decoder.bundle.files)
    choices = [asdict(choice) | {"code": choice.code.model_dump()} for choice in tried]
    write_json(json_path, {"code": best.code.model_dump(), "user_bytes_per_page": best.user_bytes, "tried": choices})
    click.echo("\n".join([HEADER, *(choice.line() for choice in tried)]))
    click.echo(f"{best.code.describe()}: {best.user_bytes} user bytes a page")
