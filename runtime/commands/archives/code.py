"""`lightpage code`: chooses how user bytes are protected on a device's pages."""

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

import click

from lightpage.cli.options import JSON, new_file
from lightpage.cli.paths import NewPath
from lightpage.codec.choose import HEADER, HEADROOM, bytes_without_headroom
from lightpage.codec.code import Code, load_code
from lightpage.errors import BundleError, CalibrationError, InvalidInputError
from lightpage.files import write_json
from lightpage.progress import note
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.coded_pages import choose_code
from lightpage.runtime.archives.recordings.evaluation import pilots_of
from lightpage.runtime.archives.recordings.read_pages import known_pages_of
from lightpage.runtime.archives.recordings.recovery import code_of
from lightpage.runtime.archives.recordings.survived_drift import KINDS, DriftedReading
from lightpage.runtime.commands.execution import Load, decoder_options
from lightpage.runtime.model.bundle.bundle import write_bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for

_UNITS = ", ".join(f"{name} ({kind.unit})" for name, kind in KINDS.items())


@click.command()
@decoder_options
@click.option("--recording", required=True, type=click.Path(), help="HDF5 recording, symbols known or user data.")
@click.option(
    "--code", "code_path", type=click.Path(path_type=Path), help="Code of user data; the recording's or the bundle's."
)
@new_file("Write the code to this TOML file.", required=False, read=load_code)
@click.option("--out-bundle", type=NewPath(), help="Write the bundle with this code in it: a folder, or a .zip.")
@click.option("--version", help="Version of the new bundle.")
@click.option(
    "--headroom",
    type=click.FloatRange(0, 0.5),
    default=HEADROOM,
    show_default=True,
    help="Share of what a symbol carries that is kept for drift.",
)
@click.option(
    "--survive",
    "drifts",
    multiple=True,
    type=(click.Choice(list(KINDS)), click.FloatRange(min=0)),
    metavar="KIND AMOUNT",
    help=f"Keep as much as this drift costs, where that is more; several come together. Kinds: {_UNITS}.",
)
@JSON
def code(
    load: Load,
    recording: str,
    code_path: Path | None,
    out: Path | None,
    out_bundle: Path | None,
    version: str | None,
    headroom: float,
    drifts: tuple[tuple[str, float], ...],
    json_path: Path | None,
) -> None:
    """Choose levels and rate of a device's page code by pages of a recording that the bundle has not seen.

    The rate is the one that 999 of 1,000 pages still carry, as far as these pages can say: more pages, a higher rate.
    Says what is kept for drift, what that costs, and how much drift of each kind pages survive. Of a recording without
    symbols, the pages of user data count that are read. The new bundle still reads pages of the bundle's earlier codes
    that have as many levels.
    """
    if out is None and out_bundle is None:
        raise InvalidInputError("options", "neither --out nor --out-bundle", "at least one of them")
    if (version is None) != (out_bundle is None):
        raise InvalidInputError("options", "one of --out-bundle and --version", "both or neither")
    decoder, asked = load(), dict(drifts)
    if len(asked) < len(drifts):
        raise InvalidInputError("--survive", ", ".join(name for name, _ in drifts), "each kind once")
    with ExitStack() as stack:
        recorded = stack.enter_context(Recording.open(recording))

        def own() -> Code:
            return code_of(recorded, decoder.bundle) if code_path is None else load_code(code_path)

        pages = stack.enter_context(known_pages_of(decoder, recorded, own))
        reading = _drifted_reading(decoder, pages, needed=bool(asked))
        unknown = [name for name in asked if reading and name not in reading.kinds]
        if reading and unknown:
            raise InvalidInputError(
                f"--survive {unknown[0]}",
                "a drift that this bundle's geometry does not know",
                f"among {', '.join(reading.kinds)}",
            )
        drift = reading.drifted(asked) if reading and asked else None
        if asked and drift is None:
            raise InvalidInputError("--survive", asked, "less drift: by this one pages are lost whatever their code")
        best, tried = choose_code(decoder, pages, tracker_for(decoder), headroom, drift)
        survived = {} if reading is None else reading.survived(best, asked)
        without = bytes_without_headroom(best, pilots_of(decoder, pages))
    if out is not None:
        best.code.save(out)
    if out_bundle is not None:
        bundle = decoder.bundle
        before = (*bundle.earlier_codes, *([] if bundle.code is None else [bundle.code]))
        earlier = tuple({each.id: each.to_toml() for each in before if each.id != best.code.id}.values())
        update = {"code": best.code.to_toml(), "earlier_codes": earlier, "version": version}
        manifest = bundle.manifest.model_copy(update=update)
        write_bundle(out_bundle, manifest, bundle.files)
    kept_bits = best.kept * best.code.coded_bits
    figures = {
        "code": best.code.model_dump(),
        "user_bytes_per_page": best.user_bytes,
        "headroom_bits_per_symbol": kept_bits,
        "user_bytes_per_page_without_headroom": without,
        "survive": asked,
        "drift_survived": survived,
        "tried": [asdict(choice) | {"code": choice.code.model_dump()} for choice in tried],
    }
    write_json(json_path, figures)
    click.echo("\n".join([HEADER, *(choice.line() for choice in tried)]))
    click.echo(f"{best.code.describe()}: {best.user_bytes} user bytes a page")
    click.echo(f"kept for drift: {kept_bits:.3f} bit a symbol; without, a page would hold about {without} bytes")
    for name, amount in survived.items():
        kind = KINDS[name]
        click.echo(f"survives: {kind.told} off by {amount:.2g} {kind.unit}")


def _drifted_reading(decoder: Decoder, recording: Recording, needed: bool) -> DriftedReading | None:
    """Return a reader of pages as of a drifted device; None where no geometry can be moved, unless it is needed."""
    try:
        return DriftedReading(decoder, recording)
    except (BundleError, CalibrationError, InvalidInputError) as error:
        if needed:
            raise
        note(f"drift: not measured, since {error}")
        return None
