"""`lightpage recalibrate` and `lightpage rollback`: a bundle offline, or a running service's model."""

import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import click

from lightpage.calibration.known_pages import first_lit_pages
from lightpage.cli.main import RESUME_KEY
from lightpage.cli.options import JSON, FiniteRange
from lightpage.cli.paths import NewPath
from lightpage.cli.progress_bar import percent_bar
from lightpage.errors import InvalidInputError, LightpageError
from lightpage.files import write_json
from lightpage.progress import Progress, warn
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import check_recording
from lightpage.runtime.archives.recordings.recovery import code_of
from lightpage.runtime.client.answers import JobInfo, Recalibrated
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.jobs import RECALIBRATION_S
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.client.wire.messages import answer_of
from lightpage.runtime.commands.client.connection import TARGET, from_environment, target_option, with_tls
from lightpage.runtime.model.bundle.manifest import check_version
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.healed_bundle import recalibrate_by_recording
from lightpage.runtime.recalibration.known_pages import read_recorded
from lightpage.runtime.recalibration.recalibration import next_version
from lightpage.runtime.recalibration.refit import refit
from lightpage.runtime.service.jobs.messages import result_message

DEFAULT_PAGES = 2


@click.command()
@click.option("--bundle", help="Bundle to start from, offline: a path or a shipped name.")
@click.option(
    "--recording",
    help="Pages with known symbols: a file, or with --target and without --send a name in the service's folder.",
)
@click.option("--out", type=NewPath(), help="New bundle, offline: a folder, or a .zip.")
@target_option(required=False, help="Recalibrate this running service instead of a bundle.")
@with_tls
@click.option(
    "--pages",
    default=DEFAULT_PAGES,
    show_default=True,
    type=click.IntRange(2),
    help="Known pages to use. Of user data six are, with --other-device eight.",
)
@click.option(
    "--timeout",
    "timeout_s",
    type=FiniteRange(0, min_open=True),
    show_default=f"{RECALIBRATION_S:.0f}",
    help="Seconds to wait for the result, with --target.",
)
@click.option("--version", help="Version of the new bundle, offline; by default the next one.")
@click.option("--send", is_flag=True, help="Send the frames of --recording, a file here, to --target.")
@click.option("--detach", is_flag=True, help="Print the job's id and return, with --target.")
@click.option(
    "--other-device",
    is_flag=True,
    help="Offline: the recording is of another device than the bundle's, its pages are of user data.",
)
@JSON
def recalibrate(
    bundle: str | None,
    recording: str | None,
    out: Path | None,
    target: str | None,
    tls: TlsFiles | None,
    pages: int,
    timeout_s: float | None,
    version: str | None,
    send: bool,
    detach: bool,
    other_device: bool,
    json_path: Path | None,
) -> None:
    """Re-fit the geometry of a drifted device from known pages; keep it unless it reads less than the one in use.

    Less is what exceeds the standard error of the comparison on pages that were not fitted to. Where nothing has
    drifted, it is kept only if it reads more by twice that.

    Offline with --bundle, --recording and --out. A recording without symbols serves too, where its pages are of user
    data: pilots, decisions and the pages' checksums then show the geometry. Over the endpoint with --target, from the
    service's source or, with --recording, from a file in its recordings folder, or with --send from a file here. The
    recalibration of a service ends with this command, unless it is told to --detach; `lightpage jobs` then tells how it
    goes.

    With --other-device, an archive is read on a drive that was never calibrated: its geometry is found from nominal, by
    the pilots of the first eight pages, and then healed by the pages themselves.
    """
    start = time.perf_counter()
    if bundle and from_environment("target"):
        target = None
    if target is not None:
        if bundle or out or version is not None or other_device:
            got = "with --bundle, --out, --version or --other-device"
            raise InvalidInputError("--target", got, "either a service or a bundle")
        if send and recording is None:
            raise InvalidInputError("--send", "without --recording", "a file whose frames are sent")
        wait_s = RECALIBRATION_S if timeout_s is None else timeout_s
        if detach:
            with LightpageClient(target, tls=tls) as client:
                job = _start(client, recording, pages, send, wait_s)
            write_json(json_path, {"job": job.id})
            click.echo(job.id)
            return
        click.get_current_context().meta[RESUME_KEY] = "the service is told to stop, and keeps its model"
        result = _remote(target, tls, recording, pages, send, wait_s)
    else:
        if send or detach:
            raise InvalidInputError("--send" if send else "--detach", "without --target", "a service")
        if timeout_s is not None:
            raise InvalidInputError("--timeout", "without --target", "a service to wait for")
        if not (bundle and recording and out):
            given = {"--bundle": bundle, "--recording": recording, "--out": out}
            lacking = ", ".join(name for name, value in given.items() if not value)
            raise InvalidInputError("options", f"no {lacking}", f"{', '.join(given)}, or --target")
        result = _offline(bundle, recording, out, pages, version, other_device=other_device)
    data = summary(result, time.perf_counter() - start)
    write_json(json_path, data)
    click.echo(table(data))


def summary(result: Recalibrated, seconds: float) -> dict[str, str | float | None]:
    """The result under the names that other programs read."""
    figures = asdict(result)
    version, image = figures.pop("model_version"), figures.pop("image") or {}
    shift = {f"image_{name}": image.get(name) for name in ("shift_x_px", "shift_y_px")}
    return {"version": version, **figures, "seconds": seconds, **shift}


def table(data: dict[str, str | float | None]) -> str:
    """The result for people."""
    return "\n".join(f"{name:<20} {value}" for name, value in data.items() if value is not None)


def _remote(
    target: str, tls: TlsFiles | None, recording: str | None, pages: int, send: bool, timeout_s: float
) -> Recalibrated:
    with LightpageClient(target, tls=tls) as client, percent_bar() as progress:
        if not send:
            return client.jobs.recalibrate(count=pages, recording=recording, progress=progress, timeout_s=timeout_s)
        until = time.monotonic() + timeout_s
        job = _start(client, recording, pages, send, timeout_s)
        try:
            return watched(client, job.id, progress, until - time.monotonic())
        except BaseException:
            with suppress(LightpageError):
                client.jobs.cancel(job.id)  # one that has ended stays as it is
            raise


def watched(client: LightpageClient, job_id: str, progress: Progress, timeout_s: float) -> Recalibrated:
    """Follow a job to its end.

    Raises:
        LightpageError: it is not done, and why.
    """
    for job in client.jobs.watch(job_id, timeout_s):
        progress(job.step, job.fraction)
        if job.error is not None:
            raise job.error
        if job.result is not None:
            return job.result
    raise LightpageError(f"job {job_id}", "an end without a result", "a recalibration's result")


def _start(client: LightpageClient, recording: str | None, pages: int, send: bool, timeout_s: float) -> JobInfo:
    if not send or recording is None:
        return client.jobs.start(count=pages, recording=recording)
    with Recording.open(recording) as file:
        known, bit_depth = read_recorded(file, first_lit_pages(file, pages, warn)), file.bit_depth
    assert known.references is not None  # of a recording
    return client.jobs.start_with_frames(
        known.pairs,
        known.symbols,
        known.references,
        levels=known.levels,
        bit_depth=bit_depth,
        pilot_mask=known.pilot_mask,
        timeout_s=timeout_s,
    )


def _offline(
    bundle: str, recording: str, out: Path, pages: int, version: str | None, *, other_device: bool
) -> Recalibrated:
    """Return what came of it."""
    if version is not None:
        check_version(version, "--version")
    decoder = Decoder.load(bundle_path(bundle))
    with percent_bar() as progress, Recording.open(recording) as file:
        check_recording(decoder, file)
        new = next_version(decoder.version) if version is None else version
        outcome = recalibrate_by_recording(
            decoder,
            file,
            pages,
            lambda: code_of(file, decoder.bundle),
            out,
            new,
            refit,
            progress,
            other_device=other_device,
        )
    return answer_of(Recalibrated, result_message(outcome))


@click.command()
@TARGET
@with_tls
@click.option("--expect", metavar="VERSION", default="", help="Refuse unless this version is in service.")
@JSON
def rollback(target: str, tls: TlsFiles | None, expect: str, json_path: Path | None) -> None:
    """Put a service's previous model back in service; `lightpage models forward` undoes it."""
    with LightpageClient(target, tls=tls) as client:
        current, before = client.models.roll_back(expect)
    write_json(json_path, {"version": current, "previous_version": before})
    click.echo(f"{current} is in service again, {before} is not")
