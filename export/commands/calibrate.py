"""`lightpage calibrate`: from nominal geometry to this device, with a few pages whose symbols are known."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import click

from lightpage.calibration.calibrate import OtherFramesError
from lightpage.calibration.document import DEFAULT_PAGES, Calibration, load_calibration
from lightpage.calibration.goodness.figure import goodness_figure
from lightpage.calibration.known_pages import first_lit_pages
from lightpage.cli.main import missing
from lightpage.cli.options import JSON, named_profile, new_file, profile_option
from lightpage.cli.paths import NewPath, OutputFile
from lightpage.cli.progress_bar import percent_bar
from lightpage.device.profile import Profile
from lightpage.errors import CalibrationError, InvalidInputError, LightpageError
from lightpage.export.commands.calibration_report import figures, losses, symbols_beside_cameras, table
from lightpage.files import replace_file, write_json
from lightpage.pictures import write_figure_png
from lightpage.progress import Progress, note, warn
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.drift import described
from lightpage.runtime.archives.recordings.new_bundle import bundle_by_graphs, calibrating_decoder
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.from_nominal import calibrate_by_graphs

_DOTS = 150
"""Dots of a picture in an inch."""
MAX_PAGES = 4
"""More cost time and add nothing that a decoder would notice."""
_CPU = "cpu"
_BUNDLE = "bundle.zip"
_NO_GRAPHS = "none"
"""Choice of torch in place of a bundle's graphs."""


@click.command()
@profile_option
@click.option("--recording", required=True, type=click.Path(path_type=Path), help="Pages with known symbols, R.h5.")
@new_file("TOML file to write the calibration to.", read=load_calibration)
@click.option(
    "--pages", default=DEFAULT_PAGES, show_default=True, type=click.IntRange(1, MAX_PAGES), help="Pages used."
)
@click.option(
    "--orientation",
    default="profile",
    show_default=True,
    type=click.Choice(["profile", "any"]),
    help="Orientation of the cameras; `any` takes mirrored or turned ones, each by itself.",
)
@click.option(
    "--picture", type=OutputFile(), help="Draw to this PNG where the light lies that the fit does not explain."
)
@click.option("--export", "bundle", type=NewPath(), help="Write a bundle that reads the device's pages too: a .zip.")
@click.option(
    "--graphs",
    metavar="BUNDLE|none",
    help="Bundle of the same profile whose graphs calibrate, without torch; `none` for torch. By default the shipped "
    "bundle, where it has the profile.",
)
@click.option(
    "--compute",
    default=_CPU,
    show_default=True,
    metavar="cpu|cuda[:N]",
    help="Processor that recovers the light's field; other ones than the CPU need torch.",
)
@JSON
def calibrate(
    profile_name: str | None,
    recording: Path,
    out: Path,
    pages: int,
    orientation: str,
    picture: Path | None,
    bundle: Path | None,
    graphs: str | None,
    compute: str,
    json_path: Path | None,
) -> None:
    """Find this device's geometry, from nominal, with the first pages of a recording that show light.

    Up to four further known pages are then read. The fit is good where they read 0.95 of what their light holds, usable
    where a code carries them, else wrong. Without further pages it is not judged. A wrong one is written too, but over
    no better one, and ends the command with an error.
    """
    start = time.perf_counter()
    if compute != _CPU:
        if graphs not in (None, _NO_GRAPHS):
            raise InvalidInputError("--graphs", f"{graphs} with --compute {compute}", "one of them")
        graphs = _NO_GRAPHS
    with Recording.open(recording) as file, percent_bar() as progress:
        profile = file.header.device(named_profile(profile_name))
        chosen = first_lit_pages(file, pages, warn)
        decoder = None if graphs == _NO_GRAPHS else calibrating_decoder(graphs, file, profile)
        upright = orientation != "any"
        try:
            calibration = _calibrated(decoder, file, profile, chosen, progress, compute, upright=upright)
        except CalibrationError as error:
            if decoder is None or graphs is not None or isinstance(error, OtherFramesError):
                raise
            note(f"{error.subject}: {error.got}; once more, with torch")
            decoder = None
            try:
                calibration = _calibrated(decoder, file, profile, chosen, progress, compute, upright=upright)
            except CalibrationError:
                raise
            except LightpageError as lacking:
                expected = f"{error.expected}, or torch for graphs of this device: {lacking}"
                raise CalibrationError(error.subject, error.got, expected) from None
        seconds = time.perf_counter() - start
        if not out.exists():
            calibration.save(out)  # an interrupted reading loses nothing
        if bundle is not None:
            bundle.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=None if bundle is None else bundle.parent) as folder:
            written = Path(folder) / (_BUNDLE if bundle is None else bundle.name)
            read = bundle is not None or (file.pages > len(chosen) and calibration.statistics is not None)
            try:
                judged = judged_by_reading(decoder, calibration, file, profile, written if read else None, progress)
            except LightpageError as error:
                if bundle is not None:
                    calibration.save(out)
                    raise
                warn(f"pages that the fit has not seen are not read: {error}")
                judged = calibration.judged(None)
            calibration = judged
            kept = calibration.is_wrong and _is_better(out)
            if not kept:
                calibration.save(out)
            if bundle is not None and not calibration.is_wrong:
                written.replace(bundle)
    lost = symbols_beside_cameras(decoder, calibration, profile)
    if json_path is not None:
        write_json(json_path, figures(calibration, profile, seconds, lost))
    click.echo(table(calibration, profile))
    if lost:
        total = profile.page.columns * profile.page.rows
        what = f"{lost} of {total} symbols: most of their light misses a camera, so little of them can be read"
        warn(what)
    if calibration.blemishes is not None and str(calibration.blemishes):
        click.echo(f"\n{calibration.blemishes}")
    if causes := losses(calibration):
        click.echo(f"\n{causes}")
    found = calibration.goodness
    if picture is not None and found is not None:
        replace_file(picture, lambda file: write_figure_png(file, goodness_figure(found), dpi=_DOTS), "picture")
    click.echo(
        f"\ncoherence {calibration.coherence_before:.3f} -> {calibration.coherence_after:.3f}, "
        f"{calibration.pages_used} known pages, {seconds:.0f} s; {'not ' * kept}written to {out}"
    )
    remedy = "the file keeps a better one: name another --out" if kept else "the file is there to be looked at"
    without = "" if bundle is None else f", and {bundle} is not written"
    calibration.check_good(f"calibration {out}", f"; {remedy}{without}")
    if found is not None:
        click.echo(calibration.verdict_sentence)
    if calibration.reading is not None and (drift := described(calibration.reading.drift)):
        click.echo(f"drift from page to page: {drift}")
    if bundle is not None:
        click.echo(f"{bundle}: version {Bundle.open(bundle).version}, after {time.perf_counter() - start:.0f} s")


def _calibrated(
    decoder: Decoder | None,
    recording: Recording,
    profile: Profile,
    pages: list[int],
    progress: Progress,
    compute: str,
    *,
    upright: bool,
) -> Calibration:
    """Calibrate by the graphs of a decoder, or by torch where it is None."""
    if decoder is not None:
        return calibrate_by_graphs(decoder, recording, pages, progress, any_orientation=not upright)
    try:
        from lightpage.train.data.torch_engine import torch_device
        from lightpage.train.trainers.calibration import calibrate_recording
    except ModuleNotFoundError as error:
        raise missing(f"lightpage calibrate, profile {profile.name}", error) from error
    device = torch_device(compute)
    return calibrate_recording(recording, profile, pages, progress, any_orientation=not upright, compute=device)


def judged_by_reading(
    decoder: Decoder | None,
    calibration: Calibration,
    recording: Recording,
    profile: Profile,
    out: Path | None,
    progress: Progress,
) -> Calibration:
    """Judge a calibration by pages that its fit has not seen, and write its bundle to `out`; None to read nothing."""
    if out is None:
        return calibration.judged(None)
    try:
        return _exported(decoder, calibration, recording, profile, out, progress).calibration
    except CalibrationError as error:  # its own pages contradict it
        return calibration.contradicted(error.got)


def _exported(
    decoder: Decoder | None,
    calibration: Calibration,
    recording: Recording,
    profile: Profile,
    out: Path,
    progress: Progress,
) -> Bundle:
    """Write the bundle of a calibration with the graphs of a decoder, or with graphs of its own."""
    if decoder is not None:
        return bundle_by_graphs(decoder, calibration, recording, out, progress=progress)
    from lightpage.export.from_calibration import export_calibration

    exported, _ = export_calibration(calibration, recording, profile, out, progress=progress)
    return exported


def _is_better(earlier: Path) -> bool:
    """Return whether a file holds a calibration that is not wrong."""
    try:
        return earlier.is_file() and not load_calibration(earlier).is_wrong
    except LightpageError:
        return False
