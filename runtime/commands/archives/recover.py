"""`lightpage recover`: reads a file back from recorded pages."""

from pathlib import Path

import click

from lightpage.cli.options import JSON
from lightpage.cli.paths import OutputFile
from lightpage.codec.code import load_code
from lightpage.codec.volume_file import parse_volume, ranges
from lightpage.files import write_json
from lightpage.progress import warn
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.recovery import Recovery, code_of, lost_data, told_losses
from lightpage.runtime.archives.recordings.recovery import recover as recover_file
from lightpage.runtime.commands.execution import Load, decoder_options
from lightpage.runtime.commands.provider_option import CODE_THREADS
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.words import counted


@click.command()
@decoder_options
@CODE_THREADS
@click.option("--recording", required=True, type=click.Path(), help="HDF5 recording of the file's pages.")
@click.option("--code", "code_path", type=click.Path(path_type=Path), help="Code; the recording's or the bundle's.")
@click.option("--out", required=True, type=OutputFile(), help="The file.")
@click.option("--volume", metavar="ID[:CHECKSUM]", help="Volume to read, where the recording holds several.")
@click.option("--holes", is_flag=True, help="Write zeros where data are lost, in place of no file.")
@click.option("--give-up", is_flag=True, help="Take pages that storage does not give for lost.")
@click.option(
    "--known-out",
    type=OutputFile(),
    help="Write the pages that are read as a recording with known symbols; its frames stay in --recording.",
)
@click.option("--heal/--no-heal", default=True, show_default=True, help="Re-fit by pages that are not read.")
@JSON
@click.option("--tracking/--no-tracking", default=True, show_default=True, help="Follow the image, and find it again.")
def recover(
    load: Load,
    code_threads: int | None,
    recording: str,
    code_path: Path | None,
    out: Path,
    volume: str | None,
    holes: bool,
    json_path: Path | None,
    give_up: bool,
    known_out: Path | None,
    heal: bool,
    tracking: bool,
) -> None:
    """Read a file back from recorded pages.

    Where the device has changed so far that the model does not read its pages, the model is fitted to it again by these
    pages alone, and reads them. Other pages that cannot be read are restored from parity pages. Where too many are
    lost, each is named, no file is written and the exit status is 3. Where storage did not give some of them, it is 75:
    the same command tries again.
    """
    decoder = load(code_threads or 1)
    with Recording.open(recording) as pages:
        code = code_of(pages, decoder.bundle) if code_path is None else load_code(code_path)
        tracker = tracker_for(decoder) if tracking else NoTracker(decoder)
        asked = parse_volume(volume)
        result = recover_file(decoder, pages, tracker, code, out, *asked, holes=holes, heals=heal, known_out=known_out)
    write_json(json_path, result.to_json())
    click.echo(describe(result))
    for line in told_losses(result.unread) if not result.lost and result.volume is not None else ():
        warn(f"no bytes: {line}")
    if (error := lost_data(result, out, holes, give_up)) is not None:
        raise error


def describe(result: Recovery) -> str:
    """The figures as a table for people."""
    figures, volume = result.to_json(), result.volume
    air, share, margin = figures["air_bytes_per_page"], figures["share_of_air"], figures["margin_bits_least"]
    lost = f"data pages {ranges(result.lost)}" if result.lost else "none" if volume is not None else "all"
    restored = "none needed" if volume is not None and not result.lost else "none could be"
    ranges_lost = ", ".join(f"{start} to {end - 1}" for start, end in figures["lost_bytes"])
    rates = f"{figures['Q']:.3f} user bits a symbol, {figures['q']:.3f} of the raw bits"
    too_many = ", more than these pages carry" if share is not None and share > 1 else ""
    rows = [
        ("code", result.code.describe()),
        ("recorded pages", f"{len(result.pages)}, of which {len(result.unread)} gave no bytes"),
        ("healed", _healed(result)),
        ("restored", f"data pages {ranges(result.restored)}" if result.restored else restored),
        ("lost", lost),
        ("bytes lost", ranges_lost or ("none" if volume is not None else "all")),
        ("volume", _volume(result)),
        ("user bytes a page", f"{result.user_bytes_per_page}"),
        ("of the AIR", "symbols unknown" if share is None else f"{share:.3f} of {air:.0f} bytes{too_many}"),
        ("Q, q", "none: no page was read" if volume is None else rates),
        ("margin", "none" if margin is None else f"at least {margin:.3f} bit a symbol"),
        ("corrected", f"{figures['corrected']} symbols by Reed-Solomon"),
        ("time", f"{1e3 * figures['seconds_per_page']:.1f} ms a page (median)"),
    ]
    return "\n".join(f"{name:<20} {value}" for name, value in rows)


def _volume(result: Recovery) -> str:
    """The volume that was read; of none, what the lost pages' headers claim."""
    if (volume := result.volume) is not None:
        return f"{volume.id}: {volume.file_bytes} bytes on {counted(volume.pages, 'page')}"
    claimed = ranges(sorted({page.volume for page in result.unread if page.volume is not None}))
    return f"{claimed}, as lost pages claim" if claimed else "unknown"


def _healed(result: Recovery) -> str:
    """Return the pages that a re-fitted model has read."""
    if not result.healed:
        return "none"
    most = max(page.healed_rounds or 0 for page in result.healed)
    return f"recorded pages {ranges([page.page for page in result.healed])}, in up to {counted(most, 'round')}"
