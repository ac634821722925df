"""`lightpage jobs`: the recalibrations of a running service."""

from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path

import click

from lightpage.cli.main import RESUME_KEY
from lightpage.cli.options import JSON, FiniteRange
from lightpage.cli.progress_bar import percent_bar
from lightpage.errors import InvalidInputError
from lightpage.files import write_json
from lightpage.runtime.client.answers import JobInfo, JobState
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.jobs import RECALIBRATION_S
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.commands.client.connection import TARGET, with_tls
from lightpage.runtime.commands.client.recalibrate import summary, table, watched


@click.command()
@TARGET
@with_tls
@click.option("--watch", metavar="ID", help="Follow this job to its end and show its result.")
@click.option("--cancel", metavar="ID", help="Stop this job at its next step.")
@click.option(
    "--timeout",
    "timeout_s",
    default=RECALIBRATION_S,
    show_default=True,
    type=FiniteRange(0, min_open=True),
    help="Seconds that --watch waits for the end; the job goes on after them.",
)
@JSON
def jobs(
    target: str, tls: TlsFiles | None, watch: str | None, cancel: str | None, timeout_s: float, json_path: Path | None
) -> None:
    """Show, follow or cancel the recalibrations of a service; without an option all that it remembers, newest first."""
    if watch is not None and cancel is not None:
        raise InvalidInputError("options", "--watch and --cancel", "one of them")
    with LightpageClient(target, tls=tls) as client:
        if watch is not None:
            again = f"job {watch} goes on; lightpage jobs --watch {watch} follows it again"
            click.get_current_context().meta[RESUME_KEY] = again
            with percent_bar() as progress:
                result = watched(client, watch, progress, timeout_s)
            data = summary(result, result.seconds)
            write_json(json_path, data)
            click.echo(table(data))
        else:
            found = client.jobs.list() if cancel is None else [client.jobs.cancel(cancel)]
            told = [{**asdict(replace(job, error=None)), "error": job.error and str(job.error)} for job in found]
            write_json(json_path, {"jobs": told})
            click.echo("\n".join(map(_line, found)) if found else "no jobs")


def _line(job: JobInfo) -> str:
    """A job in a line."""
    begun = datetime.fromtimestamp(job.created_s).astimezone().isoformat(sep=" ", timespec="seconds")
    if job.state is JobState.RUNNING:
        told = f"{job.fraction:.0%} {job.step}"
    elif job.result is not None:
        told = job.result.told
    else:
        told = str(job.error or "")
    return "  ".join(filter(None, [job.id, f"{job.state.lower():<11}", begun, job.pages_of, job.correlation_id, told]))
