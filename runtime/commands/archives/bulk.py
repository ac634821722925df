"""`lightpage bulk`: archives and fleets, page range by page range, with many workers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from pathlib import Path
from typing import Any

import click

from lightpage.cli.groups import Group
from lightpage.cli.main import RESUME_KEY
from lightpage.cli.options import JSON, FiniteRange
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.clock import SYSTEM
from lightpage.codec.code import Code, load_code
from lightpage.codec.volume_file import parse_volume
from lightpage.errors import InvalidInputError, LightpageError
from lightpage.files import write_json
from lightpage.runtime.archives.run.driver import run
from lightpage.runtime.archives.run.job import Job
from lightpage.runtime.archives.run.ledger import WHOLE, Ledger, Part
from lightpage.runtime.archives.run.question import asked_job, with_round
from lightpage.runtime.archives.run.task import KNOWN_PAGES, RANGE_PAGES, Choices, FineTuning, Operation, Problem
from lightpage.runtime.archives.run.totals import totals
from lightpage.runtime.archives.run.volumes import ALL_FILES, Wanted, recovered_files
from lightpage.runtime.archives.workers.engines import LOCAL, RAY, engine_of
from lightpage.runtime.archives.workers.fine_tuning import deep_recalibration
from lightpage.runtime.commands.archives.bulk_metrics import check_metrics, watched
from lightpage.runtime.commands.archives.bulk_result import Result
from lightpage.runtime.commands.provider_option import BATCHES, CODE_THREADS, PROVIDER
from lightpage.runtime.model.bundle.shipped import DEFAULT
from lightpage.runtime.model.execution.providers import Provider

CLOCK = SYSTEM
"""Of the pauses before what may pass is tried again."""
_FILE = click.Path(path_type=Path)
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


@click.group(cls=Group)
def bulk() -> None:
    """Read archives of recordings, or recalibrate a fleet, with many workers.

    Results and a ledger of every page go into the folder OUT. The same command again does only what is missing; without
    --recordings and --fleet it goes on with what was asked before. A range that storage does not give is tried again
    after 1, 4 and 16 seconds; then it is missing, and the same command tries it again. Exit status 2 says that pages
    are lost, or devices refused, 3 that a file is lost, and 75 that the same command may do more: something is missing,
    or another run is at work.
    """


def _tuning(name: str, kind: click.ParamType[Any], what: str) -> Decorator:
    """Return an option of `FineTuning`."""
    told = f"{what}, with --deep; {getattr(FineTuning(), name):g} by default."
    return click.option(f"--{name.replace('_', '-')}", type=kind, help=told)


def _together(*options: Decorator) -> Decorator:
    return lambda command: reduce(lambda made, option: option(made), options, command)


_options = _together(
    click.option("--metrics-file", type=OutputFile(), help="Write metrics at the end, for node_exporter: *.prom."),
    click.option("--metrics-insecure", is_flag=True, help="Let other machines read the metrics, without TLS."),
    click.option("--metrics", "metrics_address", metavar="HOST:PORT", help="Show metrics there while it runs."),
    JSON,
    click.option(
        "--part", metavar="K/N", help="Do every Nth recording or device from the Kth, K from 0; others do the rest."
    ),
    click.option("--threads", type=click.IntRange(1), help="Threads of a worker; by default its share of cores."),
    PROVIDER,
    BATCHES,
    click.option("--workers", type=click.IntRange(1), help="Number of workers; by default one for every two cores."),
    click.option("--address", help="Address of the Ray cluster, with --engine ray; `auto` for the one here."),
    click.option("--engine", type=click.Choice([LOCAL, RAY]), default=LOCAL, show_default=True, help="Runs workers."),
    click.option("--bundle", help=f"A bundle's path, or the name of a shipped one; {DEFAULT} by default."),
    click.option("--fleet", type=_FILE, help="TOML file of devices: name, bundle, recordings."),
    click.option("--recordings", multiple=True, metavar="GLOB", help="HDF5 recordings; may be given repeatedly."),
    click.argument("out", type=OutputFolder()),
)
"""Options of all operations."""
_pages_options = _together(
    click.option("--give-up", is_flag=True, help="Take pages that storage does not give in the end for lost."),
    click.option("--retry-lost", is_flag=True, help="Read ranges with lost pages once more, whatever the cause."),
    click.option("--again-with", metavar="BUNDLE", help="Read pages again that were not read well."),
    click.option("--tracking/--no-tracking", default=None, help="Follow the image within a range; the default."),
    click.option(
        "--steps",
        type=click.IntRange(1),
        help="Gauss-Newton steps of a page at most; by default all of its bundle. Bundles of a network have none.",
    ),
    click.option("--range-pages", type=click.IntRange(1), help=f"Pages of a range; {RANGE_PAGES} by default."),
)
"""Options of operations on page ranges."""


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
@CODE_THREADS
@click.option("--code", "code_path", type=_FILE, help="Code; by default the recordings' or the bundles'.")
@click.option("--heal/--no-heal", "heals", default=None, help="Re-fit by pages that are not read; the default.")
@click.option("--volume", metavar="ID[:CHECKSUM]", help="Write the file of this volume alone.")
@click.option("--holes", is_flag=True, help="Write FILE.holes, with zeros in place of lost data.")
def recover(code_path: Path | None, volume: str | None, holes: bool, **asked: Any) -> None:
    """Read files back. Pages of a file may be in several recordings."""
    code = None if code_path is None else load_code(code_path)
    _bulk(Operation.RECOVER, code=code, wanted=Wanted(*parse_volume(volume), holes), **asked)


@bulk.command()
@_options
@_pages_options
def evaluate(**asked: Any) -> None:
    """Measure bundles on pages that they have not seen."""
    _bulk(Operation.EVALUATE, **asked)


@bulk.command()
@_options
@click.option("--pages", type=click.IntRange(2), help=f"Known pages to use; {KNOWN_PAGES} by default, all with --deep.")
@click.option("--deep", is_flag=True, help="Train the network on, too, from the run that the fleet names; needs torch.")
@_tuning("steps", click.IntRange(10), "Steps of the optimiser; a second pass takes a quarter")
@_tuning("learning_rate", FiniteRange(0, min_open=True), "Peak learning rate of a one-cycle schedule")
@_tuning("synthetic_pages", click.IntRange(0), "Pages to simulate after drifts, trained on too")
@_tuning("seed", click.IntRange(0), "Seed of batches and rotations")
def recalibrate(pages: int | None, deep: bool, fleet: Path | None, **asked: Any) -> None:
    """Recalibrate devices. Each has recordings of its own; the new bundles are in OUT."""
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
    check_metrics(metrics_address, metrics_insecure, metrics_file)
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
            job = asked_job(ledger.folder, before, choices, recordings, fleet, bundle, retry_lost, CLOCK)
            if give_up:
                job = job.unopened_given_up(place for place, _ in own.sources(job))
            if choices.fine_tuning is not None:
                job = _with_checked_devices(job, ledger)
            if again_with is not None:
                job = with_round(job, again_with)
            if choices.steps is not None:
                job.check_steps()
            job.write(ledger.folder)
        if retry_lost:
            ledger.doubt_losses(job)
        with watched(ledger, operation, metrics_address, metrics_file) as watch:
            works = partial(engine_of, engine, address, workers, threads, provider)
            made = run(ledger, job, works, watch, give_up=give_up, clock=CLOCK)
        found = totals(ledger, job, made.failures)
        files = recovered_files(ledger, job, wanted) if operation is Operation.RECOVER and own == WHOLE else []
    result = Result(job, own, made, found, files)
    write_json(json_path, result.to_json())
    click.echo(result.table())
    if (error := result.failure(f"bulk run {out}")) is not None:
        raise error


def _with_checked_devices(job: Job, ledger: Ledger) -> Job:
    """Return the job, in which a device of the ledger's that cannot be recalibrated deeply has a problem."""
    sources = list(job.sources)
    for place, own in ledger.part.devices(job):
        if ledger.recalibrated(place) or any(source.problem is not None for source in own):
            continue
        first, pages = own[0], sum(source.pages for source in own)
        try:
            known = min(job.choices.known_pages or pages, pages)
            deep_recalibration().check(job.bundles[first.bundle].path, first.run, known)
        except LightpageError as error:
            sources[place] = first.model_copy(update={"problem": Problem.of(error)})
    return job.model_copy(update={"sources": tuple(sources)})
