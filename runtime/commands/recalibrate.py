"""`lightpage recalibrate` and `lightpage rollback`: a bundle offline, or a running service's model."""

from __future__ import annotations

import time
from pathlib import Path

import click

from lightpage.calibration.known_pages import first_lit_pages
from lightpage.cli.options import FiniteRange
from lightpage.cli.paths import NewPath, OutputFile
from lightpage.cli.progress_bar import percent_bar
from lightpage.errors import InvalidInputError
from lightpage.files import write_json
from lightpage.progress import warn
from lightpage.recording.reader import Recording
from runtime.bulk.evaluation import check_recording
from runtime.bundle.manifest import check_version
from runtime.bundle.shipped import bundle_path
from runtime.client.answers import Recalibrated
from runtime.client.client import RECALIBRATION_S, LightpageClient
from runtime.decoding.decoder import Decoder
from runtime.recalibration.known_pages import KnownPages
from runtime.recalibration.outcome import RecalibrationOutcome
from runtime.recalibration.recalibration import next_version
from runtime.recalibration.recalibration import recalibrate as recalibrate_bundle
from runtime.recalibration.refit import refit
from runtime.service.recalibrator import read_recorded

DEFAULT_PAGES = 2


@click.command()
@click.option("--bundle", help="Offline: the bundle to start from, a path or a shipped name.")
@click.option("--recording", help="Pages with known symbols: a file, or with --target a name in the service's folder.")
@click.option("--out", type=NewPath(), help="Offline: where the new bundle goes; a zip where it ends in .zip.")
@click.option("--target", metavar="HOST:PORT", help="Recalibrate this running service instead of a bundle.")
@click.option("--pages", default=DEFAULT_PAGES, show_default=True, type=click.IntRange(2), help="Known pages to use.")
@click.option(
    "--timeout",
    "timeout_s",
    type=FiniteRange(0, min_open=True),
    show_default=f"{RECALIBRATION_S:.0f}",
    help="With --target: seconds to wait for the result.",
)
@click.option("--version", help="Offline: version of the new bundle; by default the next one.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the result to this file.")
def recalibrate(
    bundle: str | None,
    recording: str | None,
    out: Path | None,
    target: str | None,
    pages: int,
    timeout_s: float | None,
    version: str | None,
    json_path: Path | None,
) -> None:
    """Re-fit the geometry of a drifted device from known pages, keep it only if it decodes better.

    Offline with --bundle, --recording and --out; over the endpoint with --target, from the service's source or, with
    --recording, from a file in its recordings folder.
    """
    start = time.perf_counter()
    if target is not None:
        if bundle or out or version is not None:
            raise InvalidInputError("--target", "with --bundle, --out or --version", "either a service or a bundle")
        result: RecalibrationOutcome | Recalibrated = _remote(target, recording, pages, timeout_s)
    else:
        if timeout_s is not None:
            raise InvalidInputError("--timeout", "without --target", "a service to wait for")
        if not (bundle and recording and out):
            given = {"--bundle": bundle, "--recording": recording, "--out": out}
            lacking = ", ".join(name for name, value in given.items() if not value)
            raise InvalidInputError("options", f"no {lacking}", f"{', '.join(given)}, or --target")
        result = _offline(bundle, recording, out, pages, version)
    data = summary(result, time.perf_counter() - start)
    if json_path is not None:
        write_json(json_path, data)
    click.echo("\n".join(f"{name:<20} {value}" for name, value in data.items() if value is not None))


def summary(result: RecalibrationOutcome | Recalibrated, seconds: float) -> dict[str, str | float | None]:
    """The result under the names that other programs read."""
    report = result.report if isinstance(result, RecalibrationOutcome) else result
    return {
        "version": result.version if isinstance(result, RecalibrationOutcome) else result.model_version,
        "previous_version": result.previous_version,
        "angle_deg": report.angle_deg,
        "pages_used": result.pages_used,
        "pages_held_back": result.pages_held_back,
        "seconds": seconds,
        "coherence_before": report.coherence_before,
        "coherence_after": report.coherence_after,
        "air_before": result.air_before,
        "air_after": result.air_after,
        "pages_lost_before": result.pages_lost_before,
        "image_shift_x_px": None if report.image is None else report.image.shift_x_px,
        "image_shift_y_px": None if report.image is None else report.image.shift_y_px,
    }


def _remote(target: str, recording: str | None, pages: int, timeout_s: float | None) -> Recalibrated:
    timeout_s = RECALIBRATION_S if timeout_s is None else timeout_s
    with LightpageClient(target) as client, percent_bar() as progress:
        return client.recalibrate(count=pages, recording=recording, progress=progress, timeout_s=timeout_s)


def _offline(bundle: str, recording: str, out: Path, pages: int, version: str | None) -> RecalibrationOutcome:
    if out.exists():
        raise InvalidInputError(f"--out {out}", "something that exists", "a new path: bundles are never overwritten")
    if version is not None:
        check_version(version, "--version")
    decoder = Decoder.load(bundle_path(bundle))
    with percent_bar() as progress:
        known = _read(decoder, recording, pages)
        new = next_version(decoder.version) if version is None else version
        return recalibrate_bundle(decoder, known, out, new, refit, progress)


def _read(decoder: Decoder, recording: str, pages: int) -> KnownPages:
    with Recording.open(recording) as file:
        check_recording(decoder, file)
        return read_recorded(file, first_lit_pages(file, pages, warn))


@click.command()
@click.option("--target", metavar="HOST:PORT", required=True, help="The running service.")
@click.option("--expect", metavar="VERSION", default="", help="Only if this version is in service.")
def rollback(target: str, expect: str) -> None:
    """Put a service's previous model back in service; `lightpage models forward` undoes it."""
    with LightpageClient(target) as client:
        current, before = client.rollback(expect)
    click.echo(f"{current} is in service again, {before} is not")
