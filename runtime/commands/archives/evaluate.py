"""`lightpage evaluate`: what a bundle is worth on a recording."""

from pathlib import Path

import click

from lightpage.cli.options import JSON
from lightpage.metrics.provenance import write_figures
from lightpage.progress import warn
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.drift import described, pages_until, steps_of
from lightpage.runtime.archives.recordings.evaluation import Evaluation, NothingReadError
from lightpage.runtime.archives.recordings.evaluation import evaluate as evaluate_recording
from lightpage.runtime.archives.recordings.refused import WORTH_NOTHING, refusal, unconfirmed
from lightpage.runtime.commands.execution import Load, decoder_options
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.tracking import NoTracker


@click.command()
@decoder_options
@click.option("--recording", required=True, type=click.Path(), help="HDF5 recording with known symbols.")
@JSON
@click.option("--tracking/--no-tracking", default=True, show_default=True, help="Follow the image, and find it again.")
def evaluate(load: Load, recording: str, json_path: Path | None, tracking: bool) -> None:
    """Measure a bundle on the pages of a recording that it has not seen.

    Pages that cannot be decoded, or whose pilots do not confirm the result, are left out of the figures, named, and
    make the exit status 2; pages that storage does not give make it 75.
    """
    decoder = load()
    inputs = {"bundle": decoder.bundle.path, "recording": Path(recording)}
    with Recording.open(recording) as pages:
        tracker = tracker_for(decoder) if tracking else NoTracker(decoder)
        try:
            count, result = pages.pages, evaluate_recording(decoder, pages, tracker)
        except NothingReadError as error:
            write_figures(json_path, error.figures, **inputs)
            raise error.refusal from None
    write_figures(json_path, result.to_json(), **inputs)
    click.echo(describe(result))
    if result.figures.air_bits_per_symbol <= 0:
        warn(WORTH_NOTHING)
    if result.pages_recalibration_due:
        warn(f"the pilots of {result.pages_recalibration_due} of {result.pages} pages show that the device has changed")
    if result.refused:
        raise refusal(f"recording {recording}", result.refused, count)


_MANY_LEVELS = 64
MANY = " (with so many levels, most wrong symbols are neighbours; the AIR is what a code carries)"


def describe(result: Evaluation) -> str:
    """The figures as a table for people."""
    figures = result.figures
    to_pixel = pages_until(result.drift, 1.0)
    gmi, lost = figures.gmi_bits_per_symbol, unconfirmed(result.refused)
    rows = [
        ("bundle", result.bundle_version),
        ("pages", f"{result.pages} of {figures.levels} levels"),
        ("left out", f"{result.pages_left_out} that the bundle was calibrated or trained on"),
        ("refused", f"{len(result.refused) - lost} that cannot be decoded"),
        ("not confirmed", f"{lost} whose pilots do not bear out what is claimed"),
        ("data symbols a page", f"{result.symbols_per_page}"),
        ("AIR", f"{figures.air_bits_per_symbol:.3f} bit/symbol"),
        ("before phase refit", f"{result.air_before_refit_bits_per_symbol:.3f} bit/symbol"),
        ("own MI", f"{figures.own_mi_bits_per_symbol:.3f} bit/symbol"),
        ("over-claim", f"{figures.over_claim_bits_per_symbol:.3f} bit/symbol"),
        ("GMI", "no Gray labels" if gmi is None else f"{gmi:.3f} bit/symbol"),
        ("page", f"{result.page_kb:.3f} kB"),
        ("symbol error rate", f"{figures.symbol_error_rate:.4f}{MANY if figures.levels >= _MANY_LEVELS else ''}"),
        ("ECE", f"{figures.ece:.4f}"),
        ("drift from page to page", described(steps_of(result.drift)) or "not shown"),
        (
            "image moves by 1 px",
            "not in sight" if to_pixel is None else f"in some {to_pixel:,} pages, as a random walk",
        ),
        ("decode", f"{1e3 * result.seconds_per_page:.1f} ms a page (median)"),
    ]
    return "\n".join(f"{name:<24} {value}" for name, value in rows)
