"""`lightpage bulk`: archives and fleets, page range by page range, with many workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lightpage.cli.groups import Group
from lightpage.cli.main import RESUME_KEY
from lightpage.cli.options import FiniteRange
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.clock import SYSTEM
from lightpage.codec.code import Code, load_code
from lightpage.codec.volume_file import parse_volume, ranges
from lightpage.errors import InvalidInputError, LightpageError, LostDataError, MissingResultsError
from lightpage.files import write_json
from lightpage.progress import note, warn
from lightpage.runtime.archives.run.driver import AGAIN_S, Progressed, Watch, run
from lightpage.runtime.archives.run.engine import Engine
from lightpage.runtime.archives.run.job import (
    KNOWN_PAGES,
    RANGE_PAGES,
    Choices,
    Job,
    Source,
    named_bundle,
    of_fleet,
    of_recordings,
)
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.part import WHOLE, Part
from lightpage.runtime.archives.run.task import FineTuning, Operation
from lightpage.runtime.archives.run.totals import AIR, DeviceState, Totals, totals
from lightpage.runtime.archives.run.volumes import ALL_FILES, RecoveredFile, Wanted, recovered_files
from lightpage.runtime.archives.workers.fine_tuning import deep_recalibration
from lightpage.runtime.archives.workers.local import LocalEngine, default_workers
from lightpage.runtime.client.wire.address import check_address, is_local
from lightpage.runtime.commands.provider_option import PROVIDER
from lightpage.runtime.model.bundle.shipped import DEFAULT
from lightpage.runtime.model.execution.providers import CPU, Provider

if TYPE_CHECKING:
    from lightpage.runtime.archives.run.metrics import BulkMetrics
    from lightpage.runtime.console.server import ConsoleServer

LOCAL, RAY = "local", "ray"
METRICS_SUFFIX = ".prom"

CLOCK = SYSTEM
"""Of the pauses before what may pass is tried again."""


@click.group(cls=Group)
def bulk() -> None:
    """Read archives of recordings, or recalibrate a fleet, with many workers.

    Results and a ledger of every page go into the folder OUT. The same command again does only what is missing; without
    --recordings and --fleet it goes on with what was asked before. A range that storage does not give is tried again
    after 1, 4 and 16 seconds; then it is missing, and the same command tries it again. Exit status 2 says that pages
    are lost, or devices refused, 3 that a file is lost, and 75 that the same command may do more: something is missing,
    or another run is at work.
    """


def _options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of all operations."""
    for option in (
        click.option("--metrics-file", type=OutputFile(), help="Write metrics at the end, for node_exporter: *.prom."),
        click.option("--metrics-insecure", is_flag=True, help="Let other machines read the metrics, without TLS."),
        click.option("--metrics", "metrics_address", metavar="HOST:PORT", help="Show metrics there while it runs."),
        click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file."),
        click.option(
            "--part", metavar="K/N", help="Do every Nth recording or device from the Kth, K from 0; others do the rest."
        ),
        click.option(
            "--threads", type=click.IntRange(1), help="Threads of a worker; by default its share of the cores."
        ),
        PROVIDER,
        click.option("--workers", type=click.IntRange(1), help="How many; by default one for every two cores."),
        click.option("--address", help="With --engine ray: of the cluster, `auto` for the one that runs here."),
        click.option("--engine", type=click.Choice([LOCAL, RAY]), default=LOCAL, show_default=True, help="Who works."),
        click.option("--bundle", help=f"A bundle's path, or the name of a shipped one; {DEFAULT} by default."),
        click.option(
            "--fleet", type=click.Path(path_type=Path), help="TOML file of devices: name, bundle, recordings."
        ),
        click.option(
            "--recordings", multiple=True, metavar="GLOB", help="HDF5 recordings; may be given several times."
        ),
        click.argument("out", type=OutputFolder()),
    ):
        command = option(command)
    return command


def _pages_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of operations on page ranges."""
    for option in (
        click.option("--give-up", is_flag=True, help="Take pages that storage does not give in the end for lost."),
        click.option("--retry-lost", is_flag=True, help="Read ranges with lost pages once more, whatever the cause."),
        click.option("--again-with", metavar="BUNDLE", help="Read pages again that were not read well."),
        click.option("--tracking/--no-tracking", default=None, help="Follow the image within a range; the default."),
        click.option("--range-pages", type=click.IntRange(1), help=f"Pages of a range; {RANGE_PAGES} by default."),
    ):
        command = option(command)
    return command


@bulk.command()
@_options
@_pages_options
@click.option("--symbols/--no-symbols", default=None, help="Keep symbols and confidences; the default.")
def decode(**asked: Any) -> None:
    """Decode all pages of recordings into symbols and confidences."""
    _bulk(Operation.DECODE, **asked)


@bulk.command()
@_options
@_pages_options
@click.option("--code", "code_path", type=click.Path(path_type=Path), help="Code; the recordings' or the bundles'.")
@click.option("--volume", metavar="ID[:CHECKSUM]", help="Write the file of this volume alone.")
@click.option("--holes", is_flag=True, help="Where data are lost, write FILE.holes with zeros in their place.")
def recover(code_path: Path | None, volume: str | None, holes: bool, **asked: Any) -> None:
    """Read the files back whose pages recordings show; the pages of a file may be in several recordings."""
    code = None if code_path is None else load_code(code_path)
    _bulk(Operation.RECOVER, code=code, wanted=Wanted(*parse_volume(volume), holes), **asked)


@bulk.command()
@_options
@_pages_options
def evaluate(**asked: Any) -> None:
    """Measure bundles on the pages of recordings that they have not seen."""
    _bulk(Operation.EVALUATE, **asked)


@bulk.command()
@_options
@click.option(
    "--pages", type=click.IntRange(2), help=f"Known pages to use; {KNOWN_PAGES} by default, or all with --deep."
)
@click.option("--deep", is_flag=True, help="Train the network on, too, from the run that the fleet names; needs torch.")
@click.option(
    "--steps", type=click.IntRange(10), help=f"With --deep: of the optimiser; {FineTuning().steps} by default."
)
@click.option(
    "--learning-rate",
    type=FiniteRange(0, min_open=True),
    help=f"With --deep: at its peak; {FineTuning().learning_rate:g} by default.",
)
@click.option(
    "--synthetic-pages",
    type=click.IntRange(0),
    help=f"With --deep: of the drifted device, trained on too; {FineTuning().synthetic_pages} by default.",
)
@click.option("--seed", type=click.IntRange(0), help=f"With --deep: of the training; {FineTuning().seed} by default.")
def recalibrate(pages: int | None, deep: bool, fleet: Path | None, **asked: Any) -> None:
    """Recalibrate devices, each from recordings of its own; the new bundles are in OUT."""
    given = {name: value for name in FineTuning.model_fields if (value := asked.pop(name)) is not None}
    if given and not deep:
        flag = f"--{next(iter(given)).replace('_', '-')}"
        raise InvalidInputError(flag, "without --deep", "--deep")
    if deep and asked["recordings"]:
        raise InvalidInputError("--deep", "with --recordings", "--fleet, whose file names the devices' training runs")
    tuning = FineTuning(**given) if deep else None
    _bulk(Operation.RECALIBRATE, known_pages=pages, fine_tuning=tuning, fleet=fleet, **asked)


def _bulk(
    operation: Operation,
    out: Path,
    recordings: tuple[str, ...],
    fleet: Path | None,
    bundle: str | None,
    engine: str,
    address: str | None,
    workers: int | None,
    threads: int | None,
    json_path: Path | None,
    part: str | None,
    metrics_address: str | None,
    metrics_insecure: bool,
    metrics_file: Path | None,
    again_with: str | None = None,
    give_up: bool = False,
    retry_lost: bool = False,
    wanted: Wanted = ALL_FILES,
    **chosen: bool | int | str | Code | FineTuning | None,
) -> None:
    """Run an operation; see the options. Choices that are None are as before, or the default."""
    context = click.get_current_context()
    context.meta[RESUME_KEY] = "what is done stays; run the same command again to do the rest"
    if address is not None and engine != RAY:
        raise InvalidInputError("--address", f"with --engine {engine}", f"--engine {RAY}")
    _check_metrics(metrics_address, metrics_insecure, metrics_file)
    own = WHOLE if part is None else Part.parse(part)
    with Ledger(out, own, CLOCK) as ledger:
        with ledger.question():
            before = Job.read(ledger.folder)
            given = {name: value for name, value in chosen.items() if value is not None}
            given |= {} if part is None else {"parts": own.count}
            choices = (Choices(operation=operation) if before is None else before.choices).model_copy(
                update={"operation": operation, **given}
            )
            provider = Provider.parse(choices.provider)
            job = _job(ledger.folder, before, choices, recordings, fleet, bundle, retry_lost)
            if give_up:
                job = job.unopened_given_up(place for place, _ in ledger.sources(job))
            if choices.fine_tuning is not None:
                check = partial(_check_device, ledger, choices.known_pages)
                job = job.checked(ledger.devices(job), check)
            if again_with is not None:
                job = _with_round(job, again_with)
            job.write(ledger.folder)
        ledger.doubt(job, every_loss=retry_lost)
        with _watched(ledger, operation, metrics_address, metrics_file) as watch:
            works = partial(engine_of, engine, address, workers, threads, provider)
            made = run(ledger, job, works, watch, give_up=give_up, clock=CLOCK)
        found = totals(ledger, job, made.failures)
        files = recovered_files(ledger, job, wanted) if operation is Operation.RECOVER and own == WHOLE else []
    if json_path is not None:
        write_json(json_path, figures(job, own, made, found, files))
    click.echo(table(job, own, made, found, files))
    if (error := failure(out, job, own, made, found, files)) is not None:
        raise error


def engine_of(name: str, address: str | None, workers: int | None, threads: int | None, provider: Provider) -> Engine:
    """What has the work done; see the options."""
    on_gpu = provider.name != CPU
    if name == RAY:
        from lightpage.runtime.archives.workers.ray_engine import RayEngine

        return RayEngine(address, workers, threads, gpus=int(on_gpu))
    if on_gpu:
        from lightpage.runtime.model.execution.session import check_provider  # loads onnxruntime, which takes a while

        check_provider(provider)
    return LocalEngine(workers or (1 if on_gpu else default_workers()), threads)


def _check_metrics(address: str | None, insecure: bool, file: Path | None) -> None:
    if file is not None and file.suffix != METRICS_SUFFIX:
        raise InvalidInputError("--metrics-file", file, f"*{METRICS_SUFFIX}: node_exporter reads no others")
    if address is None:
        return
    check_address("--metrics", address, least_port=0)
    if address.startswith("unix:"):
        raise InvalidInputError("--metrics", address, "HOST:PORT")
    if not insecure and not is_local(address):
        expected = "an address of this machine alone, since others reach it; or --metrics-insecure"
        raise InvalidInputError("--metrics", address, expected)


@contextmanager
def _watched(ledger: Ledger, operation: Operation, address: str | None, file: Path | None) -> Iterator[Watch]:
    """What keeps the metrics that were asked for; the file is written however the run ends."""
    if address is None and file is None:
        yield Watch()
        return
    from lightpage.runtime.archives.run.metrics import BulkMetrics  # prometheus_client, for who asks for it

    metrics = BulkMetrics(ledger.folder.name, operation, ledger.part)
    try:
        with ExitStack() as stack:
            if address is not None:
                stack.enter_context(_shown(metrics, address))
            yield metrics
    finally:
        metrics.end()
        if file is not None:
            metrics.write(file)


def _shown(metrics: BulkMetrics, address: str) -> ConsoleServer:
    """The metrics at an address, until it is closed.

    Raises:
        InvalidInputError: nobody can listen there.
    """
    from prometheus_client import make_wsgi_app

    from lightpage.runtime.console.server import ConsoleServer

    host, _, port = address.rpartition(":")
    try:
        server = ConsoleServer(make_wsgi_app(metrics.registry), int(port), host)
    except OSError as error:
        got, expected = error.strerror or error, "an address of this machine and a free port"
        raise InvalidInputError(f"--metrics {address}", got, expected) from None
    click.echo(f"metrics at http://{host}:{server.port}/metrics", err=True)
    return server


def _check_device(ledger: Ledger, known_pages: int | None, place: int, own: tuple[Source, ...], bundle: Path) -> None:
    """Check that a device can be recalibrated deeply, unless it is.

    Raises:
        LightpageError: it cannot.
    """
    if ledger.recalibrated(place):
        return
    pages = sum(source.pages for source in own)
    deep_recalibration().check(bundle, own[0].run, pages if known_pages is None else min(known_pages, pages))


def _job(
    folder: Path,
    before: Job | None,
    choices: Choices,
    recordings: tuple[str, ...],
    fleet: Path | None,
    bundle: str | None,
    retry_lost: bool,
) -> Job:
    """What is asked; that of the folder, where it is the same question or none.

    Raises:
        InvalidInputError: neither asked now nor before, or something else before.
    """
    if recordings and fleet is not None:
        raise InvalidInputError("options", "--recordings and --fleet", "one of them")
    if fleet is not None and bundle is not None:
        raise InvalidInputError("--bundle", "with --fleet", "the bundles that the fleet's file names")
    if fleet is not None:
        asked = of_fleet(choices, fleet, before)
    elif recordings:
        default = DEFAULT if before is None else str(before.bundles[0].path)
        asked = of_recordings(choices, recordings, bundle or default, before)
    elif before is None:
        got = f"no --recordings and no --fleet, and no run in {folder}"
        raise InvalidInputError("options", got, "one of them")
    else:
        asked = before.model_copy(update={"choices": choices})
        if bundle is not None:
            asked = asked.model_copy(update={"bundles": (named_bundle(bundle),) * len(before.bundles)})
    if before is not None:
        before.check(folder, asked)
        asked = before.with_bundles_of(asked).looked_at_again(given_up=retry_lost)
    for pause_s in AGAIN_S:
        if not asked.passing():
            break
        note(f"recordings or bundles could not be opened; they are tried again in {pause_s:g} s")
        CLOCK.sleep(pause_s)
        asked = asked.looked_at_again()
    return asked


def _with_round(job: Job, bundle: str) -> Job:
    """A job with one more round, if it does not have it."""
    model = named_bundle(bundle)
    known = tuple(model if other.sha256 == model.sha256 else other for other in job.rounds)
    return job.model_copy(update={"rounds": known if model in known else (*known, model)})


def figures(job: Job, part: Part, made: Progressed, found: Totals, files: list[RecoveredFile]) -> dict[str, Any]:
    """All that is known, under the names that other programs read."""
    return {
        "operation": str(job.choices.operation),
        "part": None if part == WHOLE else str(part),
        "bundles": [bundle.model_dump(mode="json") for bundle in job.bundles],
        "this_run": {
            "pages": made.pages,
            "ranges": made.ranges,
            "failed": made.failed,
            "given_up": made.given_up,
            "problems": [str(problem) for problem in made.problems],
            "seconds": made.seconds,
            "pages_per_s": made.pages_per_s,
            "worker_restarts": made.restarts,
        },
        **found.to_json(),
        **({"files": [file.to_json() for file in files]} if job.choices.operation is Operation.RECOVER else {}),
    }


def table(job: Job, part: Part, made: Progressed, found: Totals, files: list[RecoveredFile]) -> str:
    """The figures for people."""
    tally, air = found.tally, found.figures.value(AIR)
    recalibrated = job.choices.operation is Operation.RECALIBRATE
    unit = "devices" if recalibrated else "pages"
    speed = "" if made.pages_per_s is None else f" in {made.seconds:.1f} s, {made.pages_per_s:.2f} a second"
    causes = ", ".join(f"{count} {cause}" for cause, count in tally.lost.most_common())
    rows = [
        ("part", "" if part == WHOLE else f"{part}; without --part, the same command says it of all parts"),
        (unit, f"{len(found.devices)}" if recalibrated else f"{tally.pages} of {len(found.recordings)} recordings"),
        ("this run", f"{made.pages} {unit}{speed}" if made.pages or made.failed else "nothing was missing"),
        ("recalibrated" if recalibrated else "read", f"{tally.read}"),
        ("left out", f"{tally.left_out} that a bundle was made from" if tally.left_out else ""),
        ("refused" if recalibrated else "lost", f"{tally.lost.total()} ({causes})" if causes else "0"),
        ("missing", f"{tally.missing}, the next run tries them again" if tally.missing else ""),
        ("models", ", ".join(f"{version}: {count}" for version, count in tally.models.items())),
        ("device has changed", f"by {tally.recalibration_due} pages" if tally.recalibration_due else ""),
        ("AIR", "" if air is None else f"{air:.3f} bit/symbol"),
        ("workers that died", f"{made.restarts}" if made.restarts else ""),
    ]
    for each in found.rounds:
        gain = ""
        if each.air_before.value is not None and each.air_after.value is not None:
            gain = f"; AIR of them {each.air_before.value:.3f} before, {each.air_after.value:.3f} now"
        told = f"{each.pages} pages: {each.won} won, {each.better} better, {each.lost} lost still{gain}"
        rows.append((f"again, {each.model.version}", told))
    rows += [
        (f"volume {file.volume.id}", file.error or f"{file.path}, {file.volume.file_bytes} bytes") for file in files
    ]
    told = "\n".join(f"{name:<20} {value}" for name, value in rows if value)
    return f"{told}\n\n{device_table(found.devices)}" if found.devices else told


def device_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """What became of each device, for people."""

    def air(value: float | None) -> str:
        return "" if value is None else f"{value:.3f}"

    cells = [("device", "state", "AIR before", "after", "bundle, or why there is none")]
    for row in rows:
        name = row["device"] or Path(row["recordings"][0]).name
        before, after = (air(row.get(f"air_{when}")) for when in ("before", "after"))
        cells.append((name, str(row["state"]), before, after, row.get("bundle") or row["reason"]))
    widths = [max(len(cell[column]) for cell in cells) for column in range(2)]
    return "\n".join(
        f"{name:<{widths[0]}}  {state:<{widths[1]}}  {before:>10}  {after:>6}  {told}".rstrip()
        for name, state, before, after, told in cells
    )


def failure(
    out: Path, job: Job, part: Part, made: Progressed, found: Totals, files: list[RecoveredFile]
) -> LightpageError | None:
    """The error that a run ends with where something is missing or lost; None where nothing is."""
    subject, tally = f"bulk run {out}", found.tally
    lost = tally.lost.total()
    told = [*map(str, made.problems), *found.lost]
    if (more := made.failed + lost - len(told)) > 0:
        told.append(f"and {more} more")
    got, expected = f"{lost} of {tally.pages} lost and {tally.missing} missing", "pages that can be read"
    if made.given_up:
        got += f", {made.given_up} recordings given up"
    if made.failed:
        got += f", {made.failed} ranges or recordings without a result"
    if job.choices.operation is Operation.RECALIBRATE:
        failed = sum(row["state"] is DeviceState.FAILED for row in found.devices)
        got = f"{lost} of {len(found.devices)} devices refused and {failed} failed"
        expected = "known pages of each device, and all that it needs"
    got = f"{got} ({'; '.join(told)})"
    if made.failed:
        return MissingResultsError(subject, got, f"{expected}; the same command tries again what is missing")
    if job.choices.operation is Operation.RECOVER:
        if unwritten := [file for file in files if file.passes]:
            got = f"no file of volumes {ranges([file.volume.id for file in unwritten])} ({unwritten[0].error})"
            return MissingResultsError(subject, got, "room and storage for them; the same command tries again")
        broken = ranges([file.volume.id for file in files if file.error is not None])
        if broken or ((lost or made.given_up) and not files and part == WHOLE):
            what = f"volumes {broken} without a file" if broken else "no file"
            return LostDataError(subject, f"{what}; {got}", "pages that suffice for every file")
        if lost or made.given_up:
            then = "every file is whole all the same" if part == WHOLE else "the files come when all parts are done"
            warn(f"{subject}: {got}; {then}")
        return None
    return InvalidInputError(subject, got, expected) if lost or made.given_up else None
